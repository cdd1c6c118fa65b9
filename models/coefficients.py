"""What a vehicle's file says beyond its rigid body: the coefficients of effects and sensors.

`coefficients.toml` has the name, limits, unit and meaning of each. An MJCF file has them as custom
numerics named "rotorgram/GROUP.NAME" (`rotorgram/rotors.radius`), and a vehicle's TOML file as NAME
in the table GROUP. SI units, but degrees of sensors with rays; body axes x forward, y left, z up.
"""

from collections.abc import Mapping
from dataclasses import make_dataclass
from functools import cache
from typing import Annotated, Any

from .errors import InputError
from .fields import Limits, OrNone, T, check, check_names
from .files import read_own_toml

PREFIX = "rotorgram/"
_GROUPS = read_own_toml(__file__, "coefficients")
_NUMBERS = read_own_toml(__file__, "numbers")
RANGE_MODELS = read_own_toml(__file__, "range_sensors")
"""Settings of sensors with rays by kind and model; the first model of a kind is its default."""
RANGE_DEFAULTS = RANGE_MODELS.pop("defaults")
"""Settings where the model has none."""
_RAYS = RANGE_MODELS.pop("limits")
for _kind, _models in RANGE_MODELS.items():
    for _model, _numbers in _models.items():
        _own = {} if "directions" in _numbers else _RAYS[_kind]
        _GROUPS[f"sensors.{_kind}.{_model}"] = {**_own, **_RAYS["all"]}
COEFFICIENTS = {
    f"{group}.{name}": Limits(**row)
    for group, rows in _GROUPS.items()
    for name, row in rows.items()
}
"""The limits of every coefficient, by "group.name"."""


def of_group(group: str, values: Mapping[str, T]) -> dict[str, T]:
    """Values of one group by name, from values by "group.name"."""
    rows = [(*name.rpartition("."), value) for name, value in values.items()]
    return {name: value for own, _, name, value in rows if own == group}


class Coefficients(dict[str, Any]):
    """A number, a tuple of numbers or None for each of `COEFFICIENTS`.

    None: the file does not give it; then `need` refuses.
    """

    def need(self, names: str, what: str) -> tuple[Any, ...]:
        """Values of `names`: "group.name" words with spaces between.

        Raises `InputError` that names the first that is missing.

        `what` needs them: the effect or sensor, by its name.
        """
        values = tuple(map(self.__getitem__, names.split()))
        if None in values:
            name = names.split()[values.index(None)]
            raise InputError(
                f"vehicle: expected {name} in the vehicle's file, which {what} needs, got none"
            )
        return values

    @classmethod
    def read(cls, numbers: Mapping[str, object]) -> "Coefficients":
        """From numbers and lists of numbers by "group.name". Raises `InputError`."""
        values = cls(dict.fromkeys(COEFFICIENTS))
        for name, value in numbers.items():
            group = name.rpartition(".")[0]
            known = [f"{group}.{one}" for one in of_group(group, COEFFICIENTS)]
            check_names([name], known or COEFFICIENTS, "vehicle")
            values[name] = check(name, COEFFICIENTS[name], value)
        return values

    def numbers(self) -> dict[str, tuple[float, ...]]:
        """The reverse of `read`: the coefficients of the file, by "group.name"."""
        return {name: as_tuple(value) for name, value in self.items() if value is not None}


@cache
def table_of(group: str) -> type:
    """A dataclass for the numbers of a table of a vehicle's TOML file; None: not given."""
    rows = {**_GROUPS.get(group, {}), **_NUMBERS.get(group, {})}
    fields = [(name, Annotated[Any, OrNone(Limits(**row))], None) for name, row in rows.items()]
    return make_dataclass(group, fields, frozen=True, kw_only=True)


def as_tuple(value: float | tuple[float, ...]) -> tuple[float, ...]:
    """A number, or several, as a tuple."""
    return value if isinstance(value, tuple) else (value,)
