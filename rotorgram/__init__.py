"""The names that most programs need, each imported when it is first used.

    import rotorgram
    env = rotorgram.make("rotorgram/Hover-v0", vehicle="crazyflie2")

`import rotorgram.envs` makes the envs known to `gymnasium.make` as well.
"""

import sys
from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

# `python -m rotorgram.cli`: no file of the working directory takes the place of a package.
_runs_ours = sys.argv[:1] == ["-m"] and "rotorgram" in " ".join(sys.orig_argv[:4])
if _runs_ours and not sys.flags.safe_path:
    del sys.path[0]

if TYPE_CHECKING:
    from .agents import load
    from .envs import (
        EnvConfig,
        LocalVectorEnv,
        Loop,
        Outcome,
        Task,
        TaskOptions,
        make,
        make_vec,
        register,
    )
    from .models import Vehicle
    from .udp import RemoteEnv, RemoteVectorEnv

__all__ = [
    "EnvConfig", "LocalVectorEnv", "Loop", "Outcome", "RemoteEnv", "RemoteVectorEnv", "Task",
    "TaskOptions", "Vehicle", "load", "make", "make_vec", "register",
]  # fmt: skip


def import_when_used(
    package: str, others: Mapping[str, str] = MappingProxyType({})
) -> Callable[[str], Any]:
    """`__getattr__` of a package (PEP 562) that imports each name when it is first used.

    The package's own imports under `if TYPE_CHECKING` say from where, and `others` by name.
    """

    @cache
    def modules() -> dict[str, str]:
        import ast
        from pkgutil import get_data

        found = dict(others)
        for node in ast.walk(ast.parse(get_data(package, "__init__.py") or "")):
            if isinstance(node, ast.ImportFrom):
                module = "." * node.level + (node.module or "")
                found |= {one.name: module for one in node.names}
        return found

    def find(name: str) -> object:
        if name not in modules():
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(modules()[name], package), name)

    return find


__getattr__ = import_when_used(__name__)
