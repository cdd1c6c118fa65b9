"""`rotorgram/Elevation-v0` for many drones on a GPU, stepped by MuJoCo Warp; tensors stay there.

`ElevationWarpEnv` flies the task of `ElevationVectorEnv` in float32. `docs/gpu.md` says how far the
two agree, and why their random starts differ.
"""

from collections.abc import Mapping
from typing import Any, Final

import gymnasium as gym
import mujoco
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from torch.utils.dlpack import from_dlpack

from ..models import load_model
from ..models.constants import HOVER_THRUST
from ..models.frames import attitudes_in_paper_frame, positions_in_paper_frame
from .config import TELEMETRY_NAMES
from .many import ManyDrones
from .physics import CONTACT_CHECK, PhysicsError
from .task import ElevationTask

try:
    import mujoco_warp as mjw
    import warp
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "rotorgram.envs.warp: expected MuJoCo Warp, got none: pip install 'rotorgram[gpu]'",
        name=error.name,
    ) from None

__all__ = ["HIGHEST", "ElevationWarpEnv", "WarpPhysics"]

wp: Any = warp  # its types have gaps

Step = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]

HIGHEST: Final = 100.0
"""Highest target, m. float32 rounds a height of 100 m to 8 µm; much higher, a slow craft would
stand still, since what it climbs in one physics step is rounded off."""


class WarpPhysics:
    """N quadcopters on one device, each over a floor of its own: `BatchPhysics` in float32.

    Args:
        num_envs: N.
        linear_drag: As `load_model`.
        device: Warp's name of the device.
        substeps: Physics steps of each `step`.

    Attributes:
        qpos, qvel, ctrl: Live views of simulator memory, float32, shapes (N, 7), (N, 6), (N, 4).
        touching: bool, shape (N,): whether any part was in contact with the floor in the last
            `step`, looked for as often as `BatchPhysics` does.
    """

    def __init__(self, num_envs: int, linear_drag: float, device: str, substeps: int) -> None:
        model = load_model(linear_drag, visual=False)
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR  # nobody reads them
        with wp.ScopedDevice(device):
            # Seven parts may come near the floor; the craft stays level, and the two skids touch
            # it in two points each, of four rows each.
            self._data = data = mjw.make_data(model, num_envs, nconmax=8, njmax=32)
            self._model = mjw.put_model(model)
            looks = wp.zeros((-(-substeps // CONTACT_CHECK), num_envs), dtype=int)
            # DLPack shares the memory: these are made once, and nothing is copied.
            self.qpos, self.qvel = from_dlpack(data.qpos), from_dlpack(data.qvel)
            self.ctrl, self._looks = from_dlpack(data.ctrl), from_dlpack(looks)
            self._warmstart = from_dlpack(data.qacc_warmstart)
            mjw.step(self._model, data)  # compiles what is not yet in Warp's cache
            with wp.ScopedCapture() as capture:
                for i in range(len(looks)):
                    for _ in range(min(CONTACT_CHECK, substeps - i * CONTACT_CHECK)):
                        mjw.step(self._model, data)
                    wp.copy(looks[i], data.nefc)  # contacts are the only constraints there are
            self._graph = capture.graph
            wp.synchronize()
        self.touching = torch.zeros(num_envs, dtype=torch.bool, device=self.qpos.device)

    def reset(self, mask: torch.Tensor, elevation: torch.Tensor, thrust: float) -> None:
        """Put some craft at rest and level above the origin.

        Args:
            mask: Which, bool, shape (N,).
            elevation: Heights of their centres of mass above the floor, m, float32, shape (N,).
            thrust: Thrust of each rotor, N.
        """
        rows = mask[:, None]
        home = torch.zeros_like(self.qpos)
        home[:, 2], home[:, 3] = elevation, 1.0
        self.qpos.copy_(torch.where(rows, home, self.qpos))
        for state in (self.qvel, self._warmstart):
            state.masked_fill_(rows, 0.0)
        self.ctrl.masked_fill_(rows, thrust)
        self.touching = self.touching & ~mask

    def step(self, thrust: torch.Tensor) -> None:
        """Fly every craft for the `substeps`; `thrust` of each rotor, N, float32, shape (N,)."""
        self.ctrl.copy_(thrust[:, None])
        stream = None
        if self.qpos.is_cuda:  # in turn with what PyTorch does before and after
            stream = wp.stream_from_torch(torch.cuda.current_stream(self.qpos.device))
        wp.capture_launch(self._graph, stream=stream)
        self.touching = (self._looks > 0).any(dim=0)

    @property
    def tilt_cosine(self) -> torch.Tensor:
        """Cosines of the angles between the bodies' z axes and the vertical, shape (N,)."""
        return 1 - 2 * (self.qpos[:, 4:6] ** 2).sum(dim=1)

    def bad(self) -> torch.Tensor:
        """bool, shape (N,): whose states MuJoCo would warn of: not finite, or huge."""
        state = torch.cat((self.qpos, self.qvel), dim=1)
        good: torch.Tensor = (state.abs() < mujoco.mjMAXVAL).all(dim=1)
        return ~good


class ElevationWarpEnv(ManyDrones, VectorEnv[torch.Tensor, torch.Tensor, torch.Tensor]):
    """N drones with a target each: the task of `ElevationVectorEnv`, in float32 on one device.

    Spaces, options, reward, start, termination, truncation and autoreset are those of
    `ElevationVectorEnv`. What a step takes and gives are torch tensors on `device`: actions of
    shape (N, 1), or (N,) where they are discrete; observations float32 of shape (N, 3) or (N, 1),
    rewards float32 and flags bool of shape (N,). They are the caller's own.

    `info` holds `reward_elevation`, `reward_termination` and `thrust_clipped`, and with SAME_STEP
    always `final_obs` and `final_info`: their masks tell whether an episode ended.

    Starts are drawn by one `torch.Generator` on the device: a seed gives the same starts to the
    same number of drones on the same kind of device, but not those that NumPy gives.

    Args:
        num_envs: N.
        render_mode: None.
        autoreset_mode: `AutoresetMode`, or its value.
        device: `cpu`, `cuda`, `cuda:1`...; None takes a CUDA device if there is one.
        checks: Whether a step looks at its actions and states, for which the host waits twice for
            the device. Without, an action that is not finite counts as 0, a drone that waits for
            a reset flies on, and a bad state stays.
        options: Every field of `ElevationConfig`, by name; targets end at `HIGHEST`.

    Attributes:
        device: The `torch.device`.
        physics: The craft; its tensors are live views of simulator memory.

    Raises:
        ValueError: An option, seed or action is not what it should be; the envs are as before.
        PhysicsError: A state is huge or not finite; `reset` makes the envs usable again.
        gymnasium.error.ResetNeeded: A step before a reset, or (DISABLED) after an episode's end.
    """

    def __init__(
        self,
        num_envs: int = 1,
        render_mode: str | None = None,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        device: str | None = None,
        checks: bool = True,
        **options: Any,
    ) -> None:
        self.closed = True  # nothing is open yet
        if render_mode is not None:
            raise ValueError(f"render_mode: expected None, got {render_mode!r}")
        self.render_mode = None
        self._take_options(num_envs, autoreset_mode, options)
        _reachable(self.config.target)
        self._mode = self.metadata["autoreset_mode"]
        self.device, name = _device(device)
        self.physics = WarpPhysics(num_envs, self.config.linear_drag, name, self.config.substeps)
        self.checks = checks
        self._task: Any = ElevationTask(self.config)  # its operators take tensors as well
        self._generator = torch.Generator(self.device)
        self._seeded = False
        self._target = self._thrust = torch.zeros(num_envs, device=self.device)
        self._nobody = torch.zeros(num_envs, dtype=torch.bool, device=self.device)
        self._everybody = ~self._nobody
        self._terminated = self._ended = self._clipped = self._nobody
        self._steps = torch.full((num_envs,), -1, device=self.device)  # -1: not to be stepped
        self.closed = False

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[torch.Tensor, dict[str, Any]]:
        """Begin an episode, for all drones or some.

        Args:
            seed: Of the one generator, a whole number; None leaves it as it is.
            options: As in `ElevationVectorEnv.reset`, NumPy's arrays or tensors.
        """
        if seed is not None and not (isinstance(seed, int | np.integer) and 0 <= seed < 2**64):
            raise ValueError(f"seed: expected a whole number from 0 to 2**64 - 1, got {seed!r}")
        options = {
            name: value.cpu().numpy() if isinstance(value, torch.Tensor) else value
            for name, value in (options or {}).items()
        }
        mask, chosen = self._asked(options)
        if "target" in chosen:
            _reachable(options["target"])
        if seed is not None:
            self._generator.manual_seed(int(seed))
        elif not self._seeded:
            self._generator.seed()
        self._seeded = True
        which = torch.from_numpy(mask).to(self.device)
        put = {name: torch.tensor(x).to(self.device, torch.float32) for name, x in chosen.items()}
        self._begin(which, put)
        return self._observation(self._error()), self._info(which)

    def step(self, actions: torch.Tensor) -> Step:
        """Fly every drone for one control period. See the class for what follows an episode."""
        if not self._seeded:
            raise gym.error.ResetNeeded("step: expected a call of reset() first")
        flown = ~self._ended if self._mode == AutoresetMode.NEXT_STEP else self._everybody
        values = self._values(actions, flown)
        thrust, clipped = self._task.thrust(values, self._thrust)
        self._thrust, self._clipped = torch.where(flown, thrust, self._thrust), flown & clipped
        steps, self._steps = self._steps + 1, torch.full_like(self._steps, -1)
        self.physics.step(self._thrust)
        if self.checks and (bad := self.physics.bad()).any():
            ids = bad.nonzero().flatten().tolist()
            raise PhysicsError(f"bad states in envs {ids[:5]}: reset the env")
        if self._mode == AutoresetMode.NEXT_STEP:
            self._begin(self._ended)
        error = self._error()
        ending = self._task.terminated(error, self.physics.tilt_cosine, self.physics.touching)
        self._terminated = terminated = ending & flown
        truncated = (steps >= self.config.episode_length) & ~terminated & flown
        self._ended = ended = terminated | truncated
        self._steps = torch.where(flown, steps.masked_fill(ended, -1), self._steps)
        rewards = torch.where(flown, sum(self._task.reward_terms(error, terminated)), 0.0)
        observations, info = self._observation(error), self._info(self._everybody.clone())
        if self._mode == AutoresetMode.SAME_STEP:
            observations, info = self._begin_next(ended, observations, info)
        return observations, rewards, terminated, truncated, info

    def telemetry(self) -> np.ndarray:
        """What `ElevationVectorEnv` has in `info` under `telemetry_names`, copied to the host.

        float64, shape (N, 10), in the paper's frame.
        """
        out = np.empty((self.num_envs, len(TELEMETRY_NAMES)))
        qpos = self.physics.qpos.cpu().numpy().astype(np.float64)
        positions_in_paper_frame(qpos[:, :3], out[:, :3])
        attitudes_in_paper_frame(qpos[:, 3:], out[:, 3:6])
        out[:, 6:] = self.physics.ctrl.cpu().numpy()
        return out

    def _begin(self, mask: torch.Tensor, chosen: Mapping[str, torch.Tensor] | None = None) -> None:
        """Start the episodes of these drones. All draw, so that the host need not know which."""
        chosen = chosen or {}
        low, high = self.config.target_range
        draws = torch.rand((2, self.num_envs), generator=self._generator, device=self.device)
        target = chosen.get("target", low + (high - low) * draws[0])
        start = chosen.get("start", target + self.config.start_band * (2 * draws[1] - 1))
        self._target = torch.where(mask, target, self._target)
        self._thrust = self._thrust.masked_fill(mask, HOVER_THRUST)
        self.physics.reset(mask, start, HOVER_THRUST)
        self._steps = self._steps.masked_fill(mask, 0)
        self._clipped, self._ended = self._clipped & ~mask, self._ended & ~mask
        self._terminated = self._terminated & ~mask

    def _begin_next(
        self, ended: torch.Tensor, last: torch.Tensor, last_info: dict[str, Any]
    ) -> tuple[torch.Tensor, dict[str, Any]]:
        """SAME_STEP: reset those whose episode ended; their info, with that of the last step."""
        last_info |= {name: ended for name in last_info if name.startswith("_")}
        self._begin(ended)
        info = self._info(self._everybody.clone())
        info |= {"final_obs": last, "_final_obs": ended}
        info |= {"final_info": last_info, "_final_info": ended}
        return self._observation(self._error()), info

    def _error(self) -> torch.Tensor:
        return self._target - self.physics.qpos[:, 2]

    def _observation(self, error: torch.Tensor) -> torch.Tensor:
        if self.config.observation == "error":
            return error[:, None]
        rate = 0.0 - self.physics.qvel[:, 2]
        return torch.stack((error, rate, self._thrust / HOVER_THRUST - 1.0), dim=1)

    def _info(self, mask: torch.Tensor) -> dict[str, Any]:
        elevation, termination = self._task.reward_terms(self._error(), self._terminated)
        info = {"reward_elevation": elevation, "reward_termination": termination}
        info["thrust_clipped"] = self._clipped.clone()
        return info | {f"_{name}": mask for name in info}

    def _values(self, actions: Any, flown: torch.Tensor) -> torch.Tensor:
        """Actions as ElevationTask takes them: float32, shape (N,)."""
        if not isinstance(actions, torch.Tensor) or actions.device != self.device:
            got = getattr(actions, "device", type(actions).__name__)
            raise ValueError(f"actions: expected a torch tensor on {self.device}, got {got}")
        if actions.shape != self.action_space.shape or actions.is_complex():
            raise ValueError(
                f"actions: expected real numbers of shape {self.action_space.shape}, "
                f"got {actions.dtype} of shape {tuple(actions.shape)}"
            )
        values = actions.detach().reshape(self.num_envs).to(torch.float32)
        expected = "0, 1 or 2" if self._discrete else "finite numbers"
        right = values.isfinite()
        if self._discrete:
            right = (values == 0) | (values == 1) | (values == 2)
        waiting, wrong = flown & (self._steps < 0), flown & ~right
        if self.checks and (waiting | wrong).any():
            first = int((waiting if waiting.any() else wrong).nonzero()[0])
            if waiting[first]:
                sentence = f"step: expected a call of reset() for env {first} first"
                raise gym.error.ResetNeeded(sentence)
            got = values[first].item()
            raise ValueError(f"actions: expected {expected}, got {got} for env {first}")
        return torch.where(right, values - 1.0 if self._discrete else values, 0.0)


def _reachable(target: Any) -> None:
    if not np.max(target) <= HIGHEST:
        raise ValueError(f"target: expected at most {HIGHEST:g} m in float32, got {target!r}")


def _device(name: str | None) -> tuple[torch.device, str]:
    """The device for PyTorch, and its name for Warp."""
    if name is None:
        name = "cuda" if torch.cuda.is_available() and wp.is_cuda_available() else "cpu"
    try:
        ours = wp.get_device(str(name))
        theirs = torch.device(wp.device_to_torch(ours))
        torch.empty(0, device=theirs)
    except (ValueError, RuntimeError, AssertionError):
        expected = "'cpu', or a CUDA device that both Warp and PyTorch find"
        raise ValueError(f"device: expected {expected}, got {name!r}") from None
    return theirs, str(ours)
