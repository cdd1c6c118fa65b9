"""What happens to a drone in flight: a gust, a kick, a rotor that fails, a goal that moves.

An event changes a few parameters for a while, of those that are drawn for an episode and of some
more: `events.toml` says which. `stages/events.py` makes it happen.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..models.errors import InputError, shortened
from ..models.fields import Choice, Limits, Text, check, check_names, mapping
from ..models.files import read_own_toml, read_toml
from ..scenes.motion import REST, thrown
from ..scenes.obstacles import Obstacle
from .spec import Values

if TYPE_CHECKING:
    from ..scenes.solids import Solids
    from .config import EnvConfig

MAX_EVENTS = 64  # each is a bit of a request
BALL = "obstacle"
ASKED = "asked"  # condition of an event that happens at an agent's request
KINDS = read_own_toml(__file__, "events")
ALWAYS = KINDS.pop("all")
"""Of all kinds."""


def read_events(given: object) -> tuple[Values, ...]:
    """Kind and given sizes of events, from tables or from a TOML file.

    Raises `InputError`, or `OSError` for a file that cannot be read.
    """
    if isinstance(given, str):
        given = read_toml(Path(given), "events").get("events")
    if not isinstance(given, list | tuple) or len(given) > MAX_EVENTS:
        raise InputError(
            f"events: expected at most {MAX_EVENTS} tables [[events]], got {shortened(given)}"
        )
    return tuple(_read(table, f"events[{number}]") for number, table in enumerate(given))


def _read(table: object, where: str) -> Values:
    given = mapping(table, where)
    kind = check(f"{where}.kind", Choice(tuple(KINDS)), given.pop("kind", None))
    event = {"kind": kind}
    sizes = ALWAYS | KINDS[kind]
    check_names(given, sizes, where)
    if ("at" in given) == ("when" in given):
        raise InputError(f"{where}: expected at or when, got both or none")
    for name, row in sizes.items():
        rule = Text(**row["rule"]) if "pattern" in row["rule"] else Limits(**row["rule"])
        if name in given or "default" not in row:
            event[name] = check(f"{where}.{name}", rule, given.get(name))
    if event.keys().isdisjoint(KINDS[kind]):
        raise InputError(f"{where}: expected {' or '.join(KINDS[kind])}, got neither")
    return event


def steps_of(event: Values, period: float) -> float:
    """Control steps of `period` s that an event lasts; infinite where it has no end."""
    usual = period if event["kind"] == "kick" else math.inf
    return max(1.0, float(np.rint(event.get("duration", usual) / period)))


def changes_of(events: Sequence[Values], period: float) -> dict[str, NDArray[np.float64]]:
    """By how much each of E events changes parameters: by the names of these, (E,)."""
    changes: dict[str, NDArray[np.float64]] = {}
    for number, event in enumerate(events):
        sizes = KINDS[event["kind"]]
        values = {name: row.get("default") for name, row in sizes.items()} | event
        time = steps_of(event, period) * period if event["kind"] == "kick" else 1.0
        for name, row in sizes.items():
            value = 1.0 if isinstance(values[name], str) else values[name]
            sums = np.ravel(value) - row.get("less", 0.0)
            for changed, change in zip(row.get("changes", ()), sums, strict=False):
                of_all = changes.setdefault(changed.format(**values), np.zeros(len(events)))
                of_all[number] = change / time
    return changes


def asks_of(events: Sequence[Values]) -> tuple[str, ...]:
    """Of each event its kind where an agent may ask for it, otherwise an empty word; none if there
    is no such event.
    """
    kinds = [event["kind"] if event.get("when") == ASKED else "" for event in events]
    return tuple(kinds) if any(kinds) else ()


def balls_of(events: Sequence[Values]) -> "Solids":
    """What events throw, where it hangs before."""
    from ..scenes.solids import Solids  # it imports MuJoCo

    found = [event for event in events if event["kind"] == BALL]
    balls = [Obstacle(kind="sphere", size=(x["radius"],), position=x["start"]) for x in found]
    motions = [thrown(x["velocity"], math.inf) for x in found]
    return replace(Solids.of_obstacles(balls), motions=np.reshape(motions, (-1, len(REST))))


def check_events(config: "EnvConfig") -> None:
    """Refuse by name what an env has not. Raises `InputError`."""
    for number, event in enumerate(config.events):
        where = f"events[{number}]"
        check(f"{where}.drone", Limits(0, config.drones - 1, whole=True), event.get("drone", 0))
        sensor = event.get("sensor")
        if sensor and sensor not in config.sensors:
            raise InputError(f"{where}: expected a sensor of the env, got {sensor}, which is off")
        if event["kind"] == "goal" and "goal" not in config.task:
            raise InputError(f"{where}: expected a task with the option goal, got {config.env_id}")
