"""The rigid body of a vehicle in torch: no contact, on a CPU or a GPU, differentiable.

It flies as `mujoco` does until a part touches the ground, of which it tells.
"""

from typing import Any, Final

import mujoco
import numpy as np
import torch

from ...models.errors import expect
from ...models.vehicle import Vehicle
from ..effects import EffectOptions, Effects
from ..randomize import Randomization
from ..state import Array, Pose, WorldState, clip
from ..world import PhysicsError, contact_check
from .body import RigidBody, motion
from .hull import Hull
from .tensors import TensorWorld, torch_device

DTYPES: Final = {"float32": torch.float32, "float64": torch.float64}


class RigidWorld(TensorWorld):
    """W worlds of one drone over level ground: `World`, without contact.

    A craft that reaches the ground is `touching`, and flies on through it: a task ends an episode
    there. `device` is `cpu`, `cuda`, `cuda:1`...; None takes a CUDA device if there is one. With
    `dtype` float64 a seed gives the draws that it gives `mujoco`, one stream for each world.

    A step makes new tensors for the state. Where thrusts require a gradient, the state has it;
    `detach` ends it.

    `compiled` has torch compile a physics step at the first one: it needs a C++ compiler, and takes
    half a minute, or some seconds where torch's cache has it. Small batches gain most.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        num_worlds: int,
        *,
        effects: EffectOptions | None = None,
        randomize: Randomization | None = None,
        device: str | None = None,
        dtype: str = "float32",
        compiled: bool = False,
    ) -> None:
        expect(type(compiled) is bool, "compiled", "true or false", repr(compiled))
        expect(dtype in DTYPES, "dtype", " or ".join(DTYPES), repr(dtype))
        super().__init__(num_worlds, randomize, torch_device(device), DTYPES[dtype])
        self.vehicle = vehicle
        options = effects or EffectOptions()
        expected = "none with the backend rigid, which has no cable: fly it with mujoco"
        expect(not options.payload, "effects: payload", expected, f"{options.payload:g} kg")
        drawn = () if randomize is None else randomize.names
        acting = Effects(vehicle, options, self.noise, self.xp, drawn)
        self.effects = acting if acting.works else None
        self._check = contact_check(vehicle.timestep)
        self._body, self._hull = RigidBody(vehicle), Hull(vehicle, self.dtype, self.device)
        _check_forces(vehicle, self._body)
        self._advance: Any = torch.compile(self._body.fly) if compiled else self._body.fly
        self._at_once = 1 if compiled else None  # physics steps of a call
        put: Any = {"dtype": self.dtype, "device": self.device}
        self._hover, self._low, self._high = (
            torch.tensor(x, **put)
            for x in (vehicle.hover_thrust, vehicle.thrust_low, vehicle.thrust_high)
        )
        thrust = torch.zeros((num_worlds, 1, vehicle.num_rotors), **put)
        self._acting = thrust  # mean over the last physics step
        self._wrench: torch.Tensor | None = None
        level = torch.tensor((0.0, 0.0, 0.0, 1.0, *[0.0] * 9), **put)
        self._rows = level[:, None].expand(13, num_worlds)
        self.state = WorldState(
            **self._shown(),
            command=thrust,
            thrust=thrust,
            touching=torch.zeros(self.shape, dtype=torch.bool, device=self.device),
        )

    def reset(self, mask: Array, pose: Pose) -> None:
        """As `World.reset`."""
        state, rows = self.state, mask[..., None]
        begun = self._begun(mask, pose, self._hover)
        turn = begun["quaternion"]
        turn = turn / turn.square().sum(dim=-1, keepdim=True).sqrt()
        self._rows = torch.cat(
            (begun["position"], turn, begun["velocity"], begun["body_rates"]), dim=-1
        )[:, 0].T.contiguous()
        self._show()
        state.thrust = begun["thrust"]
        state.command = torch.where(rows, state.thrust, state.command)
        self._draw_parameters(mask)
        if self.parameters:
            self._body.vary({name: values[:, 0] for name, values in self.parameters.items()})
        if self.effects is not None:
            thrust = self.effects.begin(mask, state, self.parameters)
            state.thrust = torch.where(rows, thrust, state.thrust)
        self._acting = torch.where(rows, state.thrust, self._acting)
        if self._wrench is not None:
            self._wrench = torch.where(mask[:, 0], 0.0, self._wrench)
        state.touching = torch.where(mask, self._touches(), state.touching)

    def step(
        self, thrust: Array, substeps: int, mask: Array | None = None, *, again: bool = False
    ) -> None:
        """As `World.step`."""
        state = self.state
        command = thrust.expand(state.command.shape)  # one number for all rotors counts for each
        state.command = _kept(mask, command, state.command)
        touching = state.touching if again else torch.zeros_like(state.touching)
        while substeps > 0:
            self._fly(min(substeps, self._check), mask)
            touching = touching | self._touches()
            substeps -= self._check
        if self.effects is None or not self.effects.on_rotors:
            state.thrust = state.command
        state.touching = touching if mask is None else torch.where(mask, touching, state.touching)
        self._refuse_bad()

    def _fly(self, steps: int, mask: torch.Tensor | None) -> None:
        """Fly some physics steps, between which nobody looks for contact."""
        state, effects = self.state, self.effects
        acting, wrench, parts = state.command, None, None
        at_once = self._at_once or (steps if effects is None else 1)
        for _ in range(steps // at_once):
            if effects is not None:
                acting, end, push = effects.step(state, mask)
                if effects.on_rotors:
                    state.thrust = _kept(mask, end, state.thrust)
                if push is not None:
                    wrench = push[:, 0].T
                    parts = wrench.unbind(0)
            if effects is None or not effects.on_rotors:  # as MuJoCo clamps controls
                acting = clip(acting, self._low, self._high)
            new = self._advance(self._rows, acting[:, 0].T.contiguous(), parts, at_once)
            self._rows = new if mask is None else torch.where(mask[:, 0], new, self._rows)
            self._show()
        self._acting = _kept(mask, acting, self._acting)
        if wrench is not None:
            old = torch.zeros_like(wrench) if self._wrench is None else self._wrench
            self._wrench = wrench if mask is None else torch.where(mask[:, 0], wrench, old)

    def detach(self) -> None:
        """End the graph of gradients: what comes next does not depend on what was before."""
        state = self.state
        self._rows, self._acting = self._rows.detach(), self._acting.detach()
        state.command, state.thrust = state.command.detach(), state.thrust.detach()
        self._wrench = None if self._wrench is None else self._wrench.detach()
        self._show()
        if self.effects is not None:
            self.effects.detach()

    def acceleration(self) -> Array:
        """As `World.acceleration`."""
        wrench = None if self._wrench is None else self._wrench.unbind(0)
        push = self._body.push(self._acting[:, 0].T, wrench)
        return torch.stack(self._body.acceleration(motion(self._rows), push)[0], dim=-1)[:, None]

    def below(self) -> Array:
        """As `World.below`: the ground is the only surface."""
        height = self.state.position[..., 2] - self._hull.ground
        cosine = self.state.tilt_cosine
        seen = (cosine > 0) & (height >= 0)
        return torch.where(seen, height / torch.where(seen, cosine, 1.0), torch.inf)

    def close(self) -> None:
        """Nothing is to be released."""

    def _shown(self) -> dict[str, torch.Tensor]:
        """The rows as arrays of the state."""
        columns = self._rows.T[:, None]
        return {
            "position": columns[..., :3],
            "quaternion": columns[..., 3:7],
            "velocity": columns[..., 7:10],
            "body_rates": columns[..., 10:],
        }

    def _show(self) -> None:
        for name, values in self._shown().items():
            setattr(self.state, name, values)

    def _touches(self) -> torch.Tensor:
        now = motion(self._rows)
        return self._hull.touches(now.position[2], now.quaternion)[:, None]

    def _refuse_bad(self) -> None:
        if self._rows.detach().abs().amax() < mujoco.mjMAXVAL:  # not of NaN
            return
        bad = ~(self._rows.abs() < mujoco.mjMAXVAL).all(dim=0)
        ids = bad.nonzero().flatten().tolist()
        raise PhysicsError(f"the rigid body has bad states in envs {ids[:5]}: reset the env")


def _kept(mask: torch.Tensor | None, new: torch.Tensor, old: torch.Tensor) -> torch.Tensor:
    return new if mask is None else torch.where(mask[..., None], new, old)


def _check_forces(vehicle: Vehicle, body: RigidBody) -> None:
    """Refuse a vehicle that MuJoCo would move in another way: its joint, its integrator."""
    model, data = vehicle.model, mujoco.MjData(vehicle.model)
    data.qpos[2:7] = (vehicle.rest_height + 1e3, 0.8, 0.36, -0.36, 0.3168596)
    data.qvel[:] = (1.0, -2.0, 0.5, 0.4, 0.7, -0.6)
    thrust = 0.6 * vehicle.hover_thrust + 0.4 * vehicle.thrust_high
    thrust[0] = 0.5 * (vehicle.thrust_low[0] + vehicle.hover_thrust[0])
    data.ctrl[:] = thrust / [rotor.newtons for rotor in vehicle.rotors]
    data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
    rows = torch.tensor(np.concatenate((data.qpos, data.qvel)))[:, None]
    new = body.fly(rows, torch.tensor(thrust)[:, None], None, 1)[:, 0].numpy()
    change = new - rows[:, 0].numpy()
    mujoco.mj_step(model, data)
    theirs = np.concatenate((data.qpos, data.qvel)) - rows[:, 0].numpy()
    right = np.abs(change - theirs).max() <= 1e-9 * max(1.0, np.abs(theirs).max())
    expected = "RK4, and no forces but gravity, rotors, linear_drag and a fluid's on inertia boxes"
    expect(bool(right), "vehicle", f"{expected} (the backend rigid)", f"others in {vehicle.name}")
