"""What backends share: effects and random numbers."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from ...models.vehicle import Vehicle
from ..effects import EffectOptions, Effects
from ..random import RANDOMIZATION, START, Draw, Random
from ..randomize import Randomization
from ..snapshots import Arrays, Snapshot, joined, part_of
from ..state import Array, InitialState, WorldState, plain
from ..world import contact_check

_ONLY: Final = np.zeros(1, int)
_LEVEL: Final = np.array((1.0, 0.0, 0.0, 0.0))


class BaseWorld:
    """Base of all worlds: a seed gives the same draws on each. A derived class sets `state`."""

    state: WorldState

    def __init__(
        self,
        vehicle: Vehicle,
        shape: tuple[int, ...],
        effects: EffectOptions | None,
        randomize: Randomization | None,
        arguments: Mapping[str, Any],
    ) -> None:
        self.vehicle = vehicle
        self.shape = shape
        self._arguments = {
            **arguments,
            "vehicle": vehicle,
            "effects": effects,
            "randomize": randomize,
        }
        self.parameters: dict[str, Array] = {}
        self._options = effects or EffectOptions()
        self._randomize = randomize
        self._drawn = () if randomize is None else randomize.names
        self.random = Random(shape)
        acting = Effects(vehicle, self._options, self.random.noise, self._drawn)
        self.effects: Effects | None = acting if acting.works else None
        self._on_rotors = acting.on_rotors
        self._check = contact_check(vehicle.timestep)

    def seed(self, mask: Array, seeds: Sequence[int | None] | Array) -> None:
        """As `World.seed`."""
        ids = self._ids(mask).tolist()
        self.random.seed(ids, [seeds[i] for i in ids])

    def draw(self, mask: Array, chosen: Mapping[str, Array] | None = None) -> Draw:
        """As `World.draw`."""
        return self.random.start(START, self._ids(mask), chosen)

    def snapshot(self) -> Snapshot:
        """As `World.snapshot`."""
        parts = {"random": self.random.snapshot(), "state": self._snapshot()}
        parts["parameters"] = {name: np.array(x) for name, x in self.parameters.items()}
        if self.effects is not None:
            parts["effects"] = self.effects.snapshot()
        return joined(parts)

    def restore(self, arrays: Arrays) -> None:
        """As `World.restore`."""
        self.random.restore(part_of(arrays, "random"))
        parameters = part_of(arrays, "parameters")
        self.parameters = {name: plain(array.copy()) for name, array in parameters.items()}
        self._restore(part_of(arrays, "state"))
        if self.effects is not None:
            self.effects.restore(part_of(arrays, "effects"))
            self.effects.take(self.state, self.parameters)

    def _snapshot(self) -> Snapshot:
        """Copies of the backend's own arrays."""
        raise NotImplementedError

    def _restore(self, arrays: Arrays) -> None:
        """Put those back; the parameters are as they were."""
        raise NotImplementedError

    def __reduce__(self) -> tuple[object, ...]:
        return _made, (type(self), self._arguments), self.snapshot()

    def __setstate__(self, arrays: Arrays) -> None:
        self.restore(arrays)

    def _ids(self, mask: Array) -> np.ndarray:
        """The worlds of a mask; of a single one it is always true."""
        return np.flatnonzero(mask[:, 0]) if self.shape else _ONLY

    def _draw_parameters(self, mask: Array) -> None:
        """Draw the parameters of the worlds of a mask."""
        if self._randomize is not None:
            draw = Draw(self.random, RANDOMIZATION, self._ids(mask))
            for name, new in self._randomize.draw(draw).items():
                old = self.parameters.get(name)
                self.parameters[name] = plain(new if old is None else np.where(mask, new, old))

    def _begun(self, mask: Array, pose: InitialState) -> dict[str, Array]:
        """The pose's arrays by their names; those of the state for worlds out of the mask."""
        usual: dict[str, Array] = {
            "position": 0.0,
            "quaternion": _LEVEL,
            "velocity": 0.0,
            "body_rates": 0.0,
        }
        begun = {}
        for name, default in (usual | {"thrust": self.vehicle.hover_thrust}).items():
            given = getattr(pose, name)
            old = getattr(self.state, name)
            begun[name] = np.where(mask[..., None], default if given is None else given, old)
        return begun


def _made(world_class: type, arguments: Mapping[str, object]) -> object:
    """A copy of a world, before it gets its state."""
    return world_class(**arguments)
