"""Errors that the user reads as one sentence. Imports the standard library alone."""

from importlib import import_module
from types import ModuleType


class InputError(ValueError):
    """Wrong input from the user, a peer or a file. The message gives expected and actual value.

    The command line prints it. Any other `ValueError` is a bug of ours and keeps its traceback.
    """


class UnknownOption(InputError, TypeError):
    """A keyword, option or setting that does not exist; the message names those that do."""


class MissingPackage(ImportError):
    """An optional package is not installed. The message names the `pip install` that brings it."""


class NoOpenGL(RuntimeError):
    """There is no OpenGL to draw with. The sentence names what to install."""

    exit_status = 2
    """Of a command that had to draw."""


class NotCopied:
    """Base of what holds memory of a simulator, or a socket: a copy would fly wrong numbers."""

    def __reduce__(self) -> str:
        """Raise `TypeError`."""
        raise TypeError("a running env cannot be copied or pickled: make another one")


def one_line(text: object) -> str:
    """The text, or that of an error, without line breaks."""
    return " ".join(str(text).split())


def printable(text: str) -> str:
    """Text without control characters: a peer or a file may have sent it to the terminal."""
    return "".join(c if c.isprintable() or c == "\n" else "\N{REPLACEMENT CHARACTER}" for c in text)


def shortened(value: object) -> str:
    """The value's `repr` for an error, of at most 80 characters."""
    text = repr(value)
    return text if len(text) <= 80 else text[:79] + "…"


def require(module: str, extra: str, purpose: str) -> ModuleType:
    """Import an optional package, which an extra of rotorgram installs. Raises `MissingPackage`.

    `purpose` is what it is needed for, as the subject of a sentence: "training".
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] != module.partition(".")[0]:
            raise  # it is there, and lacks something of its own
        raise MissingPackage(
            f"{purpose} needs the package {error.name}: pip install 'rotorgram[{extra}]'",
            name=error.name,
        ) from None
