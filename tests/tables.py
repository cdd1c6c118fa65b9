"""Tables of numbers that tests compare with."""

import tomllib
from pathlib import Path
from typing import Any, Final

DATA: Final = Path(__file__).parent / "data"
SIM: Final[dict[str, Any]] = tomllib.loads((DATA / "sim.toml").read_text(encoding="utf-8"))
