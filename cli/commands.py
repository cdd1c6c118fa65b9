"""Every command by its name, and which errors are one sentence to the user.

Commands are frozen dataclasses: a field is a flag, its docstring the help. Heavy imports stay
inside `run`: a simulator starts without torch, an agent without MuJoCo.
"""

from typing import Any

from .flying import Evaluate, Serve
from .looking import Render, View
from .measuring import Bench, CheckModel
from .training import Compare, Report, Sweep, Train
from .wire import MakeKey, RelayFaults, Replay, Sim

__all__ = ["COMMANDS", "user_errors"]

COMMANDS: dict[str, Any] = {
    "sim": Sim,
    "train": Train,
    "serve": Serve,
    "evaluate": Evaluate,
    "view": View,
    "compare": Compare,
    "sweep": Sweep,
    "report": Report,
    "render": Render,
    "bench": Bench,
    "check-model": CheckModel,
    "key": MakeKey,
    "relay": RelayFaults,
    "replay": Replay,
}


def user_errors() -> tuple[type[Exception], ...]:
    """Errors that are one sentence to the user. A bug of ours is not among them."""
    from ..agents.episodes import ResumeError
    from ..experiments.errors import RunsFailed
    from ..rendering.gl import NoOpenGL

    return (ValueError, OSError, ResumeError, RunsFailed, NoOpenGL)
