"""What can go wrong in an experiment."""

__all__ = ["RunsFailed"]


class RunsFailed(RuntimeError):
    """Some runs of a comparison or a sweep failed."""
