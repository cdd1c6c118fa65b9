"""An `info` whose numbers are made when somebody reads one."""

from collections.abc import Callable, Mapping
from typing import Any

Info = dict[str, Any]


class LazyInfo(Info):
    """A dict that a function fills, once, before it is first used.

    Args:
        make: Gives the content. What it reads must not change any more.
    """

    _make: Callable[[], Mapping[str, Any]] | None

    def __init__(self, make: Callable[[], Mapping[str, Any]]) -> None:
        super().__init__({"": None})  # json asks no dict that is empty
        self._make = make

    def _fill(self) -> None:
        make = self._make
        if make is not None:
            content = make()
            super().clear()
            super().update(content)
            self._make = None

    def __reduce__(self) -> Any:
        return dict, (dict(self),)


def _filled(name: str) -> Callable[..., Any]:
    """A method of `dict` that fills first."""
    method = getattr(dict, name)

    def call(self: LazyInfo, *args: Any, **options: Any) -> Any:
        for info in (self, *args):  # those that are compared with it too
            if isinstance(info, LazyInfo):
                info._fill()
        return method(self, *args, **options)

    call.__name__ = name
    return call


for _name in (
    "__contains__", "__delitem__", "__eq__", "__getitem__", "__ior__", "__iter__", "__len__",
    "__ne__", "__or__", "__repr__", "__reversed__", "__ror__", "__setitem__", "clear", "copy",
    "get", "items", "keys", "pop", "popitem", "setdefault", "update", "values",
):  # fmt: skip
    setattr(LazyInfo, _name, _filled(_name))
