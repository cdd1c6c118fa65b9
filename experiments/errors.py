"""Errors of runs and of their files. Imports no other package."""

from ..models.errors import InputError

__all__ = ["ResultsError", "RunsFailed"]


class RunsFailed(RuntimeError):
    """Some runs failed; the message names each with its reason. The others are kept."""


class ResultsError(InputError):
    """A file of results is missing or is not what it should be."""
