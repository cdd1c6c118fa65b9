"""The journal of a flight: written, read, summed up and simulated again. See `docs/journal.md`."""

from ...models.errors import require

require("mcap", "record", "the journal of a flight")

from .reader import Item, Recording, Session, Summary  # noqa: E402
from .writer import Journal  # noqa: E402

__all__ = [
    "Item",
    "Journal",
    "Recording",
    "Session",
    "Summary",
]
