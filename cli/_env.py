"""Envs and policies that flags name: checkpoints, controllers, remote envs."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from .. import agents
from ..agents import (
    CONTROLLERS,
    Checkpoint,
    Controller,
    Policy,
    find_controller,
    is_controller,
    load,
)
from ..envs.config import BACKEND_KEYWORDS, KEYWORDS, BackendConfig
from ..envs.registry import env_spec, is_known, task_type
from ..envs.spec import EnvSpec
from ..flights.trajectories import Trajectory
from ..models import Backend, InputError
from ..models.library import is_pool
from ._flags import AgentFlags, EnvFlags, Options, parse_address

if TYPE_CHECKING:
    from ..envs.vector import LocalVectorEnv
    from ..udp import RemoteVectorEnv

CHECKPOINT = "checkpoint.safetensors"
UNIVERSAL = Path(agents.__file__).parent / "universal.safetensors"
"""A policy that flies every craft: `studies/universal.py` trained it."""
F = TypeVar("F", bound=EnvFlags)
_CONNECT_TIMEOUT = 30 * 24 * 3600.0  # s: Ctrl-C ends the wait for a simulator


Pilot = Checkpoint | type[Controller]


def load_pilot(name: str) -> Pilot:
    """A controller, or what `trained` gives. Raises `InputError`."""
    if is_controller(name):
        return find_controller(name)
    return trained(name, UNIVERSAL.stem, *CONTROLLERS, "FILE.py:CLASS of a controller")


def trained(name: str, *others: str) -> Checkpoint:
    """The checkpoint of a file or a training's folder.

    Raises `InputError`; the message also lists `others`.
    """
    file = checkpoint_file(name)
    if not file.is_file():
        expected = ", ".join([*others, "a checkpoint or the folder of a training"])
        raise InputError(f"policy: expected {expected}, got {name}, where there is no file {file}")
    return load(file)


def checkpoint_file(name: str) -> Path:
    """The file of a checkpoint, of a training's folder, or of the policy `universal`."""
    path = Path(name)
    if name == UNIVERSAL.stem and not path.exists():
        return UNIVERSAL
    return path / CHECKPOINT if path.is_dir() else path


def fitted(command: F, checkpoint: Pilot) -> F:
    """The command with the env that a checkpoint was trained in, or with the options that a
    controller needs.

    What the user set wins. With --listen the simulator has the vehicle. Raises `InputError` if the
    options are of another task than the checkpoint's.
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
        return replace(command, options={**checkpoint.options, **options})
    if env_id != checkpoint.env_id:
        if "env" in command.given:
            return command
        foreign = set(options).difference(KEYWORDS)
        if foreign:
            raise InputError(
                f"env: expected --env {checkpoint.env_id} with options of the task that the "
                f"policy was trained on, got {', '.join(sorted(foreign))} of {env_id}"
            )
    options = {**checkpoint.spec.options, **options}
    changes: Options = {"env": checkpoint.env_id, "options": options}
    if "drones" not in command.given:
        changes["drones"] = len(checkpoint.spec.agents)
    listens = getattr(command, "listen", None) is not None
    if checkpoint.env and not listens:
        if "vehicle" not in command.given:
            changes["vehicle"] = ",".join(checkpoint.env.vehicle_paths) or None
        if checkpoint.env.scene.is_file and "scene" not in command.given:
            from ..scenes.files import path_of  # it imports MuJoCo

            options["scene"] = path_of(checkpoint.env.scene)
    return replace(command, **changes)


def in_unseen(command: F) -> F:
    """The command in layouts that no training has seen, unless the user names the scene."""
    if not is_known(command.env_id) or getattr(command, "listen", None) is not None:
        return command
    scene = command.env_config().scene
    if "scene" in command.given or scene.layouts != "new":
        return command
    return replace(command, options={**command.options, "scene": str(scene.unseen())})


def policy_for(command: EnvFlags, checkpoint: Pilot, spec: EnvSpec) -> Policy:
    """The policy of a checkpoint, or a controller. Raises `InputError` if it does not fit the env,
    or was trained on another vehicle, no pool of craft, and the user has not named one.
    """
    if isinstance(checkpoint, type):
        return checkpoint(spec)
    own = checkpoint.spec
    drags = [one.options.get("effects", {}).get("linear_drag") for one in (own, spec)]
    same_drag = drags[0] == drags[1]
    other = own.vehicle_hash != spec.vehicle_hash and same_drag
    if other and "vehicle" not in command.given and not is_pool(own.vehicle):
        raise InputError(
            f"vehicle: expected {own.vehicle_text}, on which the policy was trained, "
            f"got {spec.vehicle_text}; name one with --vehicle"
        )
    return checkpoint.policy(spec)


def pilot_of(command: F, what: str) -> tuple[F, Policy | None]:
    """The command with the env of a policy, and the policy; None for `random`."""
    if what == "random":
        return command, None
    checkpoint = load_pilot(what)
    command = in_unseen(fitted(command, checkpoint))
    return command, policy_for(command, checkpoint, env_spec(command.env_config()))


def print_episode(trajectory: Trajectory) -> None:
    """Print the return of an episode, and the headline metric at its end."""
    spec = trajectory.spec
    words = f"episode {trajectory.episode}"
    if len(spec.agents) > 1:
        words += f" of {spec.agents[trajectory.drone]}"
    words += f": return {trajectory.rewards.sum():.1f}"
    if metric := spec.headline:
        value = f"{trajectory.headline[-1]:.3f} {metric.unit}".rstrip()
        words += f", last {metric.symbol or metric.name} {value}"
    print(words)


@contextmanager
def local_env(
    command: EnvFlags, num_envs: int, backend: Backend | BackendConfig | None
) -> Iterator["LocalVectorEnv"]:
    """A vector env in this process, without autoreset."""
    from ..envs.vector import LocalVectorEnv  # what only speaks UDP needs no MuJoCo

    config = command.env_config(backend=backend or command.backend)
    with closing(LocalVectorEnv(config, num_envs, autoreset_mode="Disabled")) as env:
        print("flying in this process (--udp: over UDP, with a simulator)")
        yield env


@contextmanager
def remote_env(
    command: AgentFlags,
    *,
    required: bool = True,
    num_envs: int | None = 1,
    num_simulators: int = 1,
    backend: Backend | BackendConfig | None = None,
) -> Iterator["RemoteVectorEnv"]:
    """A remote env with a simulator of its own, on a backend, or those that come to
    `command.listen`; at the end the counters of the wire are printed.

    It is a vector env without autoreset. `num_envs` None: as many as the first simulator has. Where
    it is `required`, simulators that come must fly this task, with these options (not the default
    ones) if there are any; otherwise the first that comes decides. Raises `InputError` for flags
    that contradict each other.
    """
    from ..udp.spawn import spawn_simulator  # a flight in this process needs no wire

    env_id = command.env_id
    options = command.options
    if command.listen is not None:
        for name in ("backend", *BACKEND_KEYWORDS):
            if name in {*command.given, *options}:
                raise InputError(
                    f"{name}: expected it of the simulator that comes: rotorgram sim --backend"
                )
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
        config = command.env_config(backend=backend or command.backend)
        drones = num_envs or command.drones
        opened = spawn_simulator(config, num_envs=drones, record=command.record)
    with opened as env:
        try:
            yield env
        finally:
            print(f"wire: {env.statistics}")


@contextmanager
def _waiting(
    command: AgentFlags, listen: str, num_envs: int | None, num_simulators: int, **settings: Any
) -> Iterator["RemoteVectorEnv"]:
    from ..udp import RemoteVectorEnv

    if command.vehicle is not None:
        settings["vehicle_hash"] = command.env_config().load_vehicle().hash
    remote = RemoteVectorEnv(
        parse_address(listen),
        num_envs=num_envs,
        num_simulators=num_simulators,
        connect=False,
        connect_timeout=_CONNECT_TIMEOUT,
        key_file=command.key_file,
        insecure=command.insecure,
        record=command.record,
        autoreset_mode="Disabled",
        **settings,
    )
    with closing(remote):
        waited = "a simulator" if num_simulators == 1 else f"{num_simulators} simulators"
        share = (num_envs or 0) // num_simulators
        if share > 1:
            waited += f" of {share} drones"
        here = "{}:{}".format(*remote.address)
        print(f"waiting for {waited} at {here} (Ctrl-C ends)")
        remote.connect()
        came = len(remote.env_spec.agents)
        if "drones" in command.given and came != command.drones:
            raise InputError(
                f"drones: expected a simulator of {command.drones} in each world, got one of {came}"
            )
        yield remote
