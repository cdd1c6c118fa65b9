"""What a policy is tried with, and trained for, where a world differs: `perturbations.toml`."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ..models.errors import InputError
from ..models.files import read_own_toml
from ..sim import PARAMETERS
from .config import EnvConfig
from .spec import Values

if TYPE_CHECKING:
    from ..models.vehicle import Vehicle

PERTURBATIONS = read_own_toml(__file__, "perturbations")
"""Tables by name."""
_OF_ONE_CRAFT = ("lag", "lag_low", "lag_high", "way", "kg", "impulse")
"""Numbers of a size that are those of one vehicle."""


def perturbed(
    config: EnvConfig, name: str, size: float, *, alone: bool = True
) -> tuple[EnvConfig, Values]:
    """The env with what a perturbation switches on, and the distributions of what it draws, alone
    or together with others.

    Raises `InputError` for an env that cannot have it.
    """
    table = PERTURBATIONS[name]
    vehicle = config.load_vehicle()
    vehicle.coefficients.need(table.get("needs", ""), name)
    own = [size for size in _OF_ONE_CRAFT if f"{{{size}}}" in str(table)]
    if own and hasattr(vehicle, "table"):
        raise InputError(f"{name}: expected one craft, as drawn:7, got the pool {vehicle.name}")
    numbers = _numbers(config, vehicle, table, size)
    changes: Values = {}
    for field in ("effects", "sensors", "events", "task"):
        if field in table:
            changes[field] = _filled(table[field], numbers)
    if "effects" in changes:
        changes["effects"] = config.effects.to_options() | changes["effects"]
    if "sensors" in changes:
        changes["sensors"] = {**config.sensors, **changes["sensors"]}
    if "events" in changes:
        changes["events"] = [*config.events, *changes["events"]]
    if "flight_band" in config.task and "room" in table:
        changes["task"] = {"flight_band": config.task["flight_band"] + table["room"]}
    if "task" in changes:
        for option in changes["task"]:
            if option not in config.task:
                raise InputError(f"{config.env_id}: expected a task with {option}, it has none")
        changes["task"] = {**config.task, **changes["task"]}
    if "backend" in table:
        changes["backend"] = table["backend"]
    changed = config.changed(**changes) if changes else config
    draws = table.get("randomize", {}) if alone else table["together"]
    return changed, _filled(draws, numbers)


def together(
    config: EnvConfig, sizes: Mapping[str, float]
) -> tuple[EnvConfig, Values, dict[str, str]]:
    """The env with several perturbations, the distributions of what all draw, and of each that it
    cannot have the sentence that says why.
    """
    drawn: Values = {}
    refused = {}
    for name, size in sizes.items():
        try:
            changed, own = perturbed(config, name, size, alone=False)
            if changed is not config:
                check(changed)
        except InputError as error:
            refused[name] = str(error)
            continue
        config = changed
        drawn |= own
    return config, drawn, refused


def for_training(config: EnvConfig, sizes: Mapping[str, float]) -> tuple[EnvConfig, dict[str, str]]:
    """The env in which each episode draws several perturbations, and of each that it cannot have
    the sentence that says why. What the env draws itself wins.
    """
    config, drawn, refused = together(config, sizes)
    return config.changed(randomize={**drawn, **config.randomize}), refused


def with_cases(config: EnvConfig, draws: Sequence[Mapping[str, Any]]) -> EnvConfig:
    """The env of which each episode draws one of several tables of distributions, its case."""
    names = sorted({name for drawn in draws for name in drawn})
    cases: Values = {}
    for name in names:
        usual = PARAMETERS[name].usual
        cases[name] = " | ".join(str(drawn.get(name, usual)) for drawn in draws)
    return replace(config, randomize={**config.randomize, **cases})


def check(config: EnvConfig) -> None:
    """Raise `InputError` for an env that cannot be flown."""
    from .vector import LocalVectorEnv  # which imports MuJoCo

    LocalVectorEnv(config, config.drones).close()


def _numbers(config: EnvConfig, vehicle: "Vehicle", table: Values, size: float) -> dict[str, float]:
    """What texts of a table stand for, by name."""
    coefficients = vehicle.coefficients
    mass = float(vehicle.mass)
    period = config.control_period or 1.0
    lag = size / 1000 / (coefficients["rotors.time_constant"] or 1.0)
    return {
        "s": size,
        "minus": 1 - size / 100,
        "plus": 1 + size / 100,
        "share": size / 100,
        "most": max(table["sizes"]),
        "of_most": size / max(table["sizes"]),
        "milli": size / 1000,
        "steps": round(size / 1000 / period),
        "lag": lag,
        "lag_low": min(lag, 1.0),
        "lag_high": max(lag, 1.0),
        "way": size / 100 * vehicle.radius,
        "kg": size / 100 * mass,
        "impulse": size * mass,
        "half": (config.episode_length or 1) * period / 2,
        "density": config.task.get("density", 0.0) * (1 + size / 100),
        "gyro": size * (coefficients["sensors.gyro_noise"] or 0.0),
        "accelerometer": size * (coefficients["sensors.accelerometer_noise"] or 0.0),
    }


def _filled(template: Any, numbers: Mapping[str, float]) -> Any:
    """A table with numbers in the place of their names."""
    if isinstance(template, Mapping):
        return {name: _filled(value, numbers) for name, value in template.items()}
    if isinstance(template, list):
        return [_filled(value, numbers) for value in template]
    if not isinstance(template, str):
        return template
    texts = {name: repr(float(number)) for name, number in numbers.items()}
    text = template.format_map(texts)
    with suppress(ValueError):
        return float(text)
    return text
