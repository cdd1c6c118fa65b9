"""MuJoCo Warp, float32, on a GPU or on the CPU; torch tensors share the simulator's memory."""

import copy
from typing import Any, Final

import mujoco
import mujoco_warp
import numpy as np
import torch
import warp
from torch.utils.dlpack import from_dlpack

from ...models.errors import InputError
from ...models.vehicle import SURROUNDINGS, Vehicle, payload_radius
from ..effects import EffectOptions, Effects
from ..randomize import Randomization
from ..rotations import body_z
from ..state import Array, InitialState, WorldState, constant
from ..world import PhysicsError, check_hung, flown_model
from .tensors import TensorWorld
from .varied import Varied

wp: Any = warp  # its types have gaps
mjw: Any = mujoco_warp

FURTHEST: Final = 100.0
"""Largest coordinate of a start, m. float32 rounds 100 m to 8 µm; much further out a slow craft
stands still, because what it flies in one physics step is rounded off."""

_DERIVED: Final = (
    "body_subtreemass", "body_invweight0", "dof_invweight0", "tendon_invweight0", "actuator_acc0"
)  # fmt: skip
"""Fields that follow from those of `Varied`: `set_const` computes them, of each world its own."""

CONTACTS_PER_GEOM: Final = 4  # Most contacts of a geom with the ground: so many have memory


class WarpWorld(TensorWorld):
    """W worlds of one drone over ground of its own: `World`, in float32 on one device.

    `device` is `cpu`, `cuda`, `cuda:1`...; None takes a CUDA device if there is one. Physics steps
    are CUDA graphs, launched on torch's current stream. Contact is looked for as often as in the
    backend `mujoco`; a craft touches where there are constraints for a contact. `qpos`, `qvel` and
    `ctrl` are live views of simulator memory, float32, shapes (W, 7), (W, 6), (W, R).
    """

    def __init__(
        self,
        vehicle: Vehicle,
        num_worlds: int,
        *,
        effects: EffectOptions | None = None,
        randomize: Randomization | None = None,
        device: str | None = None,
    ) -> None:
        theirs, self._name = _device(device)
        super().__init__(vehicle, (num_worlds, 1), effects, randomize, theirs)
        options, drawn = self._options, self._drawn
        self._cable = options.cable if options.payload else None
        self._least_height = options.cable + payload_radius(options.payload)
        model = copy.copy(flown_model(vehicle, 1, options, drawn))
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR  # nothing reads them
        if self._on_rotors:  # commands are within their limits; thrusts need not be
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
        solid = (model.geom_contype | model.geom_conaffinity) != 0
        contacts = CONTACTS_PER_GEOM * int(solid.sum())
        rows = max(1, 2 * (int(model.geom_condim.max(initial=1)) - 1))
        with wp.ScopedDevice(self._name):
            self._data = data = mjw.make_data(
                model, num_worlds, nconmax=contacts, njmax=contacts * rows + model.neq * 6 + 7
            )
            self._model = mjw.put_model(model)
            # DLPack shares the memory: these are made once, and nothing is copied.
            self.qpos, self.qvel = from_dlpack(data.qpos), from_dlpack(data.qvel)
            self.ctrl, self._rows = from_dlpack(data.ctrl), from_dlpack(data.nefc)
            self._warmstart = from_dlpack(data.qacc_warmstart)
            self._applied = from_dlpack(data.qfrc_applied)
            self._varied = Varied(model, drawn, self.xp)
            if self._varied.fields:
                for name in (*self._varied.fields, *_DERIVED):
                    shared = getattr(self._model, name)
                    own = np.repeat(shared.numpy(), num_worlds, axis=0)
                    setattr(self._model, name, wp.array(own, dtype=shared.dtype))
            self.qpos[:, 2] = vehicle.rest_height + 1.0
            if self._cable is not None:  # slack, and off the ground
                self.qpos[:, 2] += 2 * self._least_height
                self.qpos[:, 9] = self.qpos[:, 2] - 0.999 * self._cable
            mjw.step(self._model, data)  # compiles what is not yet in Warp's cache
            wp.synchronize()
            self._forward = self._captured(mjw.forward, 1)
            self._qacc = from_dlpack(data.qacc)
        self._ray: Any = None  # made by what first asks for it
        self._rows_in_air = int(self._rows.max()) + (self._cable is not None)  # a taut cable's
        self._steps: dict[int, Any] = {}
        newtons = np.array([rotor.newtons for rotor in vehicle.rotors])
        self._newtons = constant(newtons, self.ctrl)
        command = torch.zeros((num_worlds, 1, vehicle.num_rotors), device=self.device)
        self.state = WorldState(
            position=self.qpos[:, None, :3],
            quaternion=self.qpos[:, None, 3:7],
            velocity=self.qvel[:, None, :3],
            body_rates=self.qvel[:, None, 3:6],
            command=command,
            thrust=torch.zeros_like(command) if self._on_rotors else command,
            touching=torch.zeros(self.shape, dtype=torch.bool, device=self.device),
            payload=None if self._cable is None else self.qpos[:, None, 7:10],
            payload_velocity=None if self._cable is None else self.qvel[:, None, 6:9],
        )

    def reset(self, mask: Array, pose: InitialState) -> None:
        """As `World.reset`.

        Raises `InputError` for a position beyond `FURTHEST`, or a payload that would hang in the
        ground.
        """
        state, rows = self.state, mask[..., None]
        far = (pose.position.abs() > FURTHEST).any(dim=-1) & mask
        if far.any():
            got = [round(x, 3) for x in pose.position[far][0].tolist()]
            raise InputError(
                f"start: expected coordinates within {FURTHEST:g} m for the float32 of the "
                f"backend warp, got {got}"
            )
        if self._cable is not None and mask.any():
            check_hung(float(pose.position[mask][:, 2].min()), self._least_height)
        for name, values in self._begun(mask, pose).items():
            getattr(state, name).copy_(values)
        state.command.copy_(torch.where(rows, state.thrust, state.command))
        self._warmstart.masked_fill_(mask, 0.0)
        self._applied.masked_fill_(mask, 0.0)
        self._draw_parameters(mask)
        if self._varied.fields:
            with wp.ScopedDevice(self._name), wp.ScopedStream(self._stream()):
                for name, changed in self._varied.values(self.parameters).items():
                    wp.to_torch(getattr(self._model, name)).copy_(changed)
                mjw.set_const(self._model, self._data)
        if self.effects is not None:
            thrust = self.effects.begin(mask, state, self.parameters)
            state.thrust.copy_(torch.where(rows, thrust, state.thrust))
        if self._cable is not None:
            self._place_payload(mask, self._cable)
        self._apply_thrust(state.thrust)
        self._launch(self._forward)
        state.touching.copy_(torch.where(mask, self._contact(), state.touching))

    def step(
        self, thrust: Array, substeps: int, mask: Array | None = None, *, again: bool = False
    ) -> None:
        """As `World.step`."""
        state, thrust, before = self.state, thrust.detach(), []
        if mask is not None:
            thrust = torch.where(mask[..., None], thrust, state.command)
            before = [(array, array.clone()) for array in (self.qpos, self.qvel, self._warmstart)]
        state.command.copy_(thrust)
        if self.effects is None:
            self._apply_thrust(state.command)
        touching = state.touching.clone() if again else torch.zeros_like(state.touching)
        while substeps > 0:
            steps = min(substeps, self._check)
            at_once = steps if self.effects is None else 1
            if at_once not in self._steps:
                self._steps[at_once] = self._captured(mjw.step, at_once)
            for _ in range(steps // at_once):
                if self.effects is not None:
                    self._act(self.effects, mask)
                self._launch(self._steps[at_once])
            touching = touching | self._contact()
            substeps -= self._check
        for array, values in before:
            array.copy_(torch.where(mask, array, values))  # type: ignore[arg-type]
        if mask is not None:
            touching = torch.where(mask, touching, state.touching)
        state.touching.copy_(touching)
        bad = ~(torch.cat((self.qpos, self.qvel), dim=1).abs() < mujoco.mjMAXVAL).all(dim=1)
        if bad.any():
            ids = bad.nonzero().flatten().tolist()
            raise PhysicsError(f"MuJoCo Warp gave bad states in envs {ids[:5]}: reset the env")

    def acceleration(self) -> Array:
        """As `World.acceleration`."""
        before = self._warmstart.clone()
        self._launch(self._forward)
        self._warmstart.copy_(before)
        return self._qacc[:, None, :3].clone()

    def below(self) -> Array:
        """As `World.below`, by the rays of MuJoCo Warp."""
        if self._ray is None:
            self._ray = self._captured_ray()
        graph, origin, down, distance, *_ = self._ray
        origin.copy_(self.state.position)
        down.copy_(-body_z(self.state.quaternion))
        self._launch(graph)
        return torch.where(distance < 0, torch.inf, distance)

    def close(self) -> None:
        """Release the graphs."""
        self._steps.clear()

    def _apply_thrust(self, thrust: torch.Tensor) -> None:
        self.ctrl.copy_(thrust[:, 0] / self._newtons)

    def _act(self, effects: Effects, mask: torch.Tensor | None) -> None:
        """Let the effects act on some worlds before a physics step."""
        mean, end, wrench = effects.step(self.state, mask)
        if effects.on_rotors:
            kept = end if mask is None else torch.where(mask[..., None], end, self.state.thrust)
            self.state.thrust.copy_(kept)
        self._apply_thrust(mean)
        if wrench is not None:
            self._applied[:, :6] = wrench[:, 0]

    def _place_payload(self, mask: torch.Tensor, cable: float) -> None:
        """Hang the payload straight below the craft, moving along with it."""
        below = self.qpos[:, :3] - torch.tensor((0.0, 0.0, cable), device=self.device)
        turn = torch.tensor((1.0, 0.0, 0.0, 0.0), device=self.device).expand(len(below), 4)
        hung = torch.cat((self.qpos[:, :7], below, turn), dim=1)
        still = torch.zeros_like(below)
        moved = torch.cat((self.qvel[:, :6], self.qvel[:, :3], still), dim=1)
        self.qpos.copy_(torch.where(mask, hung, self.qpos))
        self.qvel.copy_(torch.where(mask, moved, self.qvel))

    def _contact(self) -> torch.Tensor:
        return (self._rows > self._rows_in_air)[:, None]

    def _captured(self, function: Any, times: int) -> Any:
        """A CUDA graph that calls a function of model and data; on the CPU, the call itself."""
        with wp.ScopedDevice(self._name), wp.ScopedCapture() as capture:
            for _ in range(times):
                function(self._model, self._data)
        return capture.graph

    def _captured_ray(self) -> Any:
        """A graph; its tensors of origins, directions and distances; what else it holds."""
        worlds, model = self.shape[0], self._model
        with wp.ScopedDevice(self._name):
            rays = [wp.zeros((worlds, 1), dtype=wp.vec3) for _ in range(3)]
            distance, geom = wp.zeros((worlds, 1), dtype=float), wp.zeros((worlds, 1), dtype=int)
            body = wp.array([-1], dtype=int)
            seen = wp.types.vector(6, float)(*map(float, SURROUNDINGS))

            def cast(model: Any, data: Any) -> None:
                mjw.kinematics(model, data)
                mjw.rays(model, data, *rays[:2], seen, True, body, distance, geom, rays[2])

            cast(model, self._data)
            wp.synchronize()
            graph = self._captured(cast, 1)
        return graph, *(wp.to_torch(array) for array in (*rays[:2], distance)), *rays, geom, body

    def _launch(self, graph: Any) -> None:
        wp.capture_launch(graph, stream=self._stream())

    def _stream(self) -> Any:
        """That of torch, for what comes between its calls; None on the CPU."""
        if not self.qpos.is_cuda:
            return None
        return wp.stream_from_torch(torch.cuda.current_stream(self.device))


def _device(name: str | None) -> tuple[torch.device, str]:
    """The device for torch, and its name for Warp. Raises `InputError`."""
    if name is None:
        name = "cuda" if torch.cuda.is_available() and wp.is_cuda_available() else "cpu"
    try:
        ours = wp.get_device(str(name))
        theirs = torch.device(wp.device_to_torch(ours))
        torch.empty(0, device=theirs)
    except (ValueError, RuntimeError, AssertionError):
        expected = "'cpu', or a CUDA device that both Warp and torch find"
        raise InputError(f"device: expected {expected}, got {name!r}") from None
    return theirs, str(ours)
