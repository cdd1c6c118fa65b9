"""Envs and policies that flags name: a task's id and options, checkpoints, remote envs."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, TypeVar

from ..agents import CONTROLLERS, PID, Checkpoint, Geometric, Orca, Policy, load
from ..envs.config import BACKEND_KEYWORDS, EnvConfig
from ..envs.registry import env_spec, is_known, task_type
from ..envs.spec import EnvSpec
from ..flights.trajectories import Trajectory
from ..models import Backend
from ..models.errors import InputError
from ..udp import RemoteVectorEnv
from ..udp.spawn import spawn_simulator
from ._flags import AgentFlags, EnvFlags, Options, check_count, parse_address

CHECKPOINT: Final = "checkpoint.safetensors"
F = TypeVar("F", bound=EnvFlags)
Controller = type[PID] | type[Geometric] | type[Orca]
_CONNECT_TIMEOUT: Final = 30 * 24 * 3600.0  # s: Ctrl-C ends the wait for a simulator


def load_checkpoint(name: str) -> Checkpoint | Controller:
    """One of `CONTROLLERS`, or what `trained` gives. Raises `InputError`."""
    return CONTROLLERS[name] if name in CONTROLLERS else trained(name, *CONTROLLERS)


def trained(name: str, *others: str) -> Checkpoint:
    """The checkpoint of a file or a training's folder.

    Raises `InputError`; the message also lists `others`.
    """
    path = Path(name)
    file = path / CHECKPOINT if path.is_dir() else path
    several = path / "checkpoints"
    got = f"{name}, where there is no file {file}"
    got += f": look into {several}" if several.is_dir() else ""
    expected = ", ".join([*others, "a checkpoint or the folder of a training"])
    if not file.is_file():
        raise InputError(f"policy: expected {expected}, got {got}")
    return load(file)


def chosen_env(
    command: EnvFlags, checkpoint: Checkpoint | Controller | None = None
) -> tuple[str, Options]:
    """Id of the task, and its options that are not the default.

    A checkpoint brings those that it was trained with, a controller those it needs;
    options that the user set win. Raises `InputError` if they are of another task than the
    checkpoint's.
    """
    env_id = command.env_id
    options = command.options
    if isinstance(checkpoint, type):
        level = checkpoint.options.get("action")
        is_needed = level and "action" not in options and is_known(env_id)
        if is_needed and level not in task_type(env_id).actions:
            raise InputError(
                f"{checkpoint.__name__.lower()}: expected a task flown by {level}, "
                f"got {env_id}; name one with --env"
            )
        return env_id, {**checkpoint.options, **options}
    if checkpoint is None or ("env" in command.given and env_id != checkpoint.env_id):
        return env_id, options
    if options and env_id != checkpoint.env_id:
        raise InputError(
            f"env: expected --env {checkpoint.env_id} with options of the task that the policy "
            f"was trained on, got options of {env_id}"
        )
    env = checkpoint.env_id, {**checkpoint.options, **options}
    own = getattr(command, "listen", None) is None  # a simulator of our own flies it
    if own and is_known(env[0]):
        drones = chosen_drones(command, checkpoint)
        _check_vehicle(command, checkpoint, env_spec(_config(command, env, drones)))
    return env


def _config(command: EnvFlags, env: tuple[str, Options], drones: int) -> EnvConfig:
    """The config of an env with the vehicle of the flags."""
    env_id, options = env
    return EnvConfig.from_keywords(env_id, vehicle=command.vehicle, drones=drones, **options)


def chosen_drones(command: EnvFlags, checkpoint: Checkpoint | Controller | None) -> int:
    """Drones of each world: those of the flag, or with which the checkpoint was trained."""
    if isinstance(checkpoint, Checkpoint) and "drones" not in command.given:
        same = "env" not in command.given or command.env_id == checkpoint.env_id
        return len(checkpoint.spec.agents) if same else command.drones
    return command.drones


def chosen_vehicle(command: EnvFlags, checkpoint: Checkpoint | Controller | None) -> str | None:
    """The vehicle of the flags, or else the vehicle of the checkpoint's env.

    With --listen the simulator has the vehicle: only the flag counts.
    """
    env = checkpoint.env if isinstance(checkpoint, Checkpoint) else None
    comes = getattr(command, "listen", None) is not None
    another = "env" in command.given and env is not None and command.env_id != env.env_id
    if env is None or comes or another or "vehicle" in command.given:
        return command.vehicle
    return ",".join(env.vehicle_paths) or None


def with_vehicle(command: F, *names: str) -> F:
    """The command with the vehicle of its flag, or else of the first policy that has a vehicle."""
    for name in names:
        if name != "random" and Path(name).suffix != ".mcap":
            vehicle = chosen_vehicle(command, load_checkpoint(name))
            if vehicle is not None:
                return replace(command, vehicle=vehicle)
    return command


def policy_for(command: EnvFlags, checkpoint: Checkpoint | Controller, spec: EnvSpec) -> Policy:
    """The policy of a checkpoint, or a controller. Raises `InputError` if it does not fit the env,
    or was trained on another vehicle and the user has not named one.
    """
    if isinstance(checkpoint, type):
        return checkpoint(spec)
    _check_vehicle(command, checkpoint, spec)
    return checkpoint.policy(spec)


def _check_vehicle(command: EnvFlags, checkpoint: Checkpoint, spec: EnvSpec) -> None:
    """Raise `InputError` if the vehicle is not the policy's and the user has not named it."""
    trained = checkpoint.spec
    drags = [one.options.get("effects", {}).get("linear_drag") for one in (trained, spec)]
    same_drag = drags[0] == drags[1]
    other = trained.vehicle_hash != spec.vehicle_hash and same_drag
    if other and "vehicle" not in command.given:
        then, now = (f"{one.vehicle} (model {one.vehicle_hash[:8]})" for one in (trained, spec))
        raise InputError(
            f"vehicle: expected {then}, on which the policy was trained, got {now}; "
            "name one with --vehicle"
        )


def pilot_of(command: EnvFlags, what: str) -> tuple[Checkpoint | None, Policy | None, EnvConfig]:
    """Checkpoint (None without one), policy (None for `random`) and env of what flies here."""
    if what == "random":
        return None, None, _config(command, chosen_env(command), command.drones)
    checkpoint = load_checkpoint(what)
    command = replace(command, vehicle=chosen_vehicle(command, checkpoint))
    env = chosen_env(command, checkpoint)
    config = _config(command, env, chosen_drones(command, checkpoint))
    policy = policy_for(command, checkpoint, env_spec(config))
    return None if isinstance(checkpoint, type) else checkpoint, policy, config


def words_of(trajectory: Trajectory) -> str:
    """Return of an episode, and the headline metric at its end."""
    words = f"return {trajectory.rewards.sum():.1f}"
    if (metric := trajectory.spec.headline) is None:
        return words
    value = f"{trajectory.headline[-1]:.3f} {metric.unit}".rstrip()
    return f"{words}, last {metric.symbol or metric.name} {value}"


@contextmanager
def remote_env(
    command: AgentFlags,
    env_id: str,
    options: Options,
    *,
    required: bool = True,
    num_envs: int | None = 1,
    num_simulators: int = 1,
    drones: int = 1,
    backend: Backend = "mujoco",
) -> Iterator[RemoteVectorEnv]:
    """A remote env with a simulator of its own, on a backend, or those that come to
    `command.listen`; at the end the counters of the wire are printed.

    It is a vector env without autoreset. `num_envs` None: as many as the first simulator has. Where
    it is `required`, simulators that come must fly this task, with these options (not the default
    ones) if there are any; otherwise the first that comes decides. Raises `InputError` for flags
    that contradict each other.
    """
    if command.listen is not None:
        theirs = "it of the simulator that comes: rotorgram sim --backend"
        for name in ("backend", *BACKEND_KEYWORDS):
            if name in {*command.given, *options}:
                raise InputError(f"{name}: expected {theirs}")
        settings = {"env_id": env_id, "options": options or None} if required else {}
        opened = _waiting(command, command.listen, num_envs, num_simulators, **settings)
    else:
        if num_simulators != 1:
            raise InputError(f"num-simulators: expected 1 without --listen, got {num_simulators}")
        if command.key_file or command.insecure:
            raise InputError(
                "key-file, insecure: expected them with --listen, "
                "got them for a simulator of our own on this machine"
            )
        if not is_known(env_id):
            raise InputError(
                f"env: expected --env MODULE:{env_id}, "
                "for the task is not known here without the module that registers it"
            )
        config = EnvConfig.from_keywords(
            env_id, drones=drones, vehicle=command.vehicle, backend=backend, **options
        )
        opened = spawn_simulator(config, num_envs=num_envs or drones, record=command.record)
    with opened as env:
        try:
            yield env
        finally:
            print(f"wire: {env.statistics}", flush=True)


@contextmanager
def _waiting(
    command: AgentFlags, listen: str, num_envs: int | None, num_simulators: int, **settings: Any
) -> Iterator[RemoteVectorEnv]:
    check_count("drones", command.drones)
    if command.vehicle is not None:
        from ..models.fleet import load_vehicles  # an agent needs no MuJoCo otherwise

        settings["vehicle_hash"] = load_vehicles(command.vehicle, command.drones).hash
    settings |= {
        "connect": False, "connect_timeout": _CONNECT_TIMEOUT, "key_file": command.key_file,
        "insecure": command.insecure, "record": command.record,
        "num_simulators": num_simulators, "autoreset_mode": "Disabled",
    }  # fmt: skip
    remote = RemoteVectorEnv(parse_address(listen), num_envs=num_envs, **settings)
    with closing(remote):
        waited = "a simulator" if num_simulators == 1 else f"{num_simulators} simulators"
        share = (num_envs or 0) // num_simulators
        waited += f" of {share} drones" if share > 1 else ""
        here = "{}:{}".format(*remote.address)
        print(f"waiting for {waited} at {here} (Ctrl-C ends)", flush=True)
        remote.connect()
        came = len(remote.env_spec.agents)
        if "drones" in command.given and came != command.drones:
            raise InputError(
                f"drones: expected a simulator of {command.drones} in each world, got one of {came}"
            )
        yield remote
