"""A trained policy as one file that flies without rotorgram: ONNX, C, C# or TorchScript.

The file has the whole of `NetworkPolicy.act`: normalisation of the observation, layers, activation,
squashing, mapping to the env's action, clipping to its bounds; or the choice of the largest output.
The action is the deterministic one. Every number is float32.
"""

import json
from importlib import import_module
from typing import Final

from ...envs.spec import EnvSpec
from ...models.errors import require
from ..checkpoints import Checkpoint
from ..policies import flat_size

FORMAT: Final = 1
"""Version of the metadata and of the names in the files."""

TARGETS: Final = {
    "onnx": "policy.onnx",
    "c": "rotorgram_policy.h",
    "csharp": "RotorgramPolicy.cs",
    "torchscript": "policy.pt",
}
"""Name of the file of each target, by default."""

_PACKAGES: Final = {"onnx": ("onnx", "export"), "torchscript": ("torch", "train")}
"""Package that writes the file of a target, and the extra that installs it."""

_SPEC: Final = (
    "env_id", "options", "control_period", "vehicle", "vehicle_hash", "observation", "action"
)  # fmt: skip


def export(checkpoint: Checkpoint, target: str) -> bytes:
    """The content of the file. `target` is one of `TARGETS`.

    Raises `MissingPackage` if a package that writes the file is not installed.
    """
    if target in _PACKAGES:
        require(*_PACKAGES[target], f"--to {target}")
    module = import_module(f"{__name__}.{target}")
    told = metadata(
        checkpoint.spec,
        algorithm=checkpoint.algorithm,
        seed=checkpoint.seed,
        env_steps=checkpoint.position.env_steps,
    )
    content: bytes = module.write(checkpoint.policy(), told)
    return content


def metadata(spec: EnvSpec, *, algorithm: str, seed: int, env_steps: int) -> dict[str, str]:
    """What a reader of the file must know, by name.

    `format`, `algorithm`, `seed`, `env_steps` (trained so far), and of the spec `env_id`,
    `options`, `control_period` (s), `vehicle`, `vehicle_hash`, `observation`, `action`; `inputs` is
    the length of the observation as the file takes it: all arrays of the spec, one after the other.
    A value that is not a text is JSON.
    """
    fields = json.loads(spec.to_json())
    told = {
        "format": FORMAT,
        "algorithm": algorithm,
        "seed": seed,
        "env_steps": env_steps,
        "inputs": flat_size(spec),
        **{name: fields[name] for name in _SPEC},
    }
    return {
        name: value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
        for name, value in told.items()
    }
