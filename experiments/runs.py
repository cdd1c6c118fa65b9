"""What comparisons and sweeps have in common: a training on a worker, and the `config.json`."""

import json
import platform
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from joblib import cpu_count

from ..agents.checkpoints import software_versions, write_whole
from ..envs import ElevationConfig
from ..models import model_hash
from ..models.constants import PHYSICS_TIMESTEP
from .progress import ProgressSender
from .records import CONFIG_FILE
from .training import AnyEnv, Run, Training

__all__ = ["config_env", "train_run", "write_config"]


def train_run(
    run: Run, env: AnyEnv, progress: ProgressSender, snapshots: int = 0
) -> tuple[Training, dict[str, Any]]:
    """Train to the end.

    Args:
        run: What to train.
        env: Of as many drones as the run has.
        progress: Told how far it is.
        snapshots: As of `Training`.

    Returns:
        The training, and how long it took: `env_steps`, `seconds` and `steps_per_second`.
    """
    training = Training(run, env, snapshots=snapshots)

    def on_update() -> bool:
        progress.rarely(training.progress)
        return True

    training.train(on_update)
    env_steps, seconds = training.log.env_steps, training.log.seconds
    progress(run.env_steps, run.env_steps, "evaluating")
    return training, {
        "env_steps": env_steps,
        "seconds": seconds,
        "steps_per_second": env_steps / seconds,
    }


def write_config(
    folder: Path, command: str, env: ElevationConfig, content: Mapping[str, Any]
) -> None:
    """Write `config.json`: the content, and what the numbers depend on besides.

    Args:
        folder: Where to; a file that is there stays: whoever goes on keeps the settings.
        command: What the user typed.
        env: The task.
        content: Settings of the comparison or the sweep; with them all of `CONFIG_KEYS` are there.
    """
    path = folder / CONFIG_FILE
    if path.exists():
        return
    whole = {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": command,
        **content,
        "env": {**asdict(env), "physics_timestep": PHYSICS_TIMESTEP},
        "versions": software_versions(),
        "model_hash": model_hash(env.linear_drag),
        "machine": {
            "platform": platform.platform(),
            "processor": platform.machine(),
            "cores": cpu_count(),
        },
    }
    write_whole(path, (json.dumps(whole, indent=2) + "\n").encode())


def config_env(content: Mapping[str, Any]) -> ElevationConfig:
    """The task of a `config.json`. Raises `KeyError`, `TypeError` or `ValueError`."""
    options = {k: v for k, v in content["env"].items() if k != "physics_timestep"}
    return ElevationConfig.from_options(options)
