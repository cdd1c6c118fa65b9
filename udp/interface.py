"""What an agent must know of the env that it flies, and whether a simulator has that one."""

import json
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from gymnasium import spaces

from ..envs import ENV_ID, TELEMETRY_NAMES, ElevationConfig
from ..envs.config import action_space, observation_space
from .fleet import describe, make_env, options_text
from .messages import Hello

__all__ = ["Interface", "announced", "known", "refusal", "same_space"]


@dataclass(frozen=True, kw_only=True)
class Interface:
    """Spaces, names and times of an env."""

    observation: spaces.Box
    action: spaces.Space[Any]
    telemetry: tuple[str, ...]
    control_period: float
    """s."""
    options: str
    """As `Hello.options`."""
    drones: int | None = None
    """Drones of one simulator; None if any number will do."""
    model_hash: str = ""
    """As `Hello.model_hash`; empty if any will do."""


def announced(hello: Hello) -> Interface:
    """What a simulator says of its env."""
    action: spaces.Space[Any]
    if hello.discrete_actions:
        action = spaces.Discrete(hello.discrete_actions)
    else:
        action = spaces.Box(hello.action_low, hello.action_high, dtype=np.float32)
    return Interface(
        observation=spaces.Box(hello.observation_low, hello.observation_high, dtype=np.float32),
        action=action,
        telemetry=hello.telemetry_names,
        control_period=hello.control_period,
        options=hello.options,
        drones=hello.num_drones,
        model_hash=hello.model_hash,
    )


def known(env_id: str, options: dict[str, Any]) -> Interface:
    """What follows from an env id, without MuJoCo where the env is ours."""
    if env_id == ENV_ID:
        config = ElevationConfig.from_options(options)
        return Interface(
            observation=observation_space(config),
            action=action_space(config),
            telemetry=TELEMETRY_NAMES,
            control_period=config.control_period,
            options=options_text(config),
        )
    with closing(make_env(env_id, options)) as env:
        return replace(announced(describe(env)), drones=None, model_hash="")


def refusal(env_id: str, expected: Interface | None, drones: int | None, hello: Hello) -> str:
    """Why not to fly the simulator of this Hello, or ""."""
    if hello.env_id != env_id:
        return f"expected a simulator of {env_id}, got one of {hello.env_id}"
    if drones is not None and hello.num_drones != drones:
        return f"expected a simulator of {_drones(drones)}, got one of {hello.num_drones}"
    got = announced(hello)
    if (theirs := _options(got.options)) is None:
        return f"options: expected a JSON object, got {got.options[:80]}"
    if expected is None:
        return ""
    if differences := _differences(_options(expected.options) or {}, theirs):
        return differences
    if not (
        same_space(got.observation, expected.observation)
        and same_space(got.action, expected.action)
    ):
        return (
            f"expected {expected.observation} and {expected.action} as the options say, "
            f"got {got.observation} and {got.action}"
        )
    if expected.telemetry and got.telemetry != expected.telemetry:
        return f"expected the telemetry {expected.telemetry}, got {got.telemetry}"
    if expected.model_hash and got.model_hash != expected.model_hash:
        return f"expected a simulator of the model {expected.model_hash}, got {got.model_hash}"
    return ""


def same_space(one: spaces.Space[Any], other: spaces.Space[Any]) -> bool:
    """Whether two spaces are equal in every bit; Gymnasium takes bounds for equal that are near."""
    if isinstance(one, spaces.Box) and isinstance(other, spaces.Box):
        bounds = [(space.low.tobytes(), space.high.tobytes()) for space in (one, other)]
        return bounds[0] == bounds[1]
    return one == other


def _drones(count: int) -> str:
    return "one drone" if count == 1 else f"{count} drones"


def _options(text: str) -> dict[str, Any] | None:
    """Options of a Hello: none if it tells none; None if they are no JSON object."""
    try:
        options = json.loads(text or "{}")
    except (ValueError, RecursionError):
        return None
    return options if isinstance(options, dict) else None


def _differences(ours: dict[str, Any], theirs: dict[str, Any]) -> str:
    """In which options two envs differ, in a sentence; "" if in none, or if one tells none."""
    differing = [
        f"{name} {value!r}, got {theirs.get(name)!r}"
        for name, value in ours.items()
        if theirs and theirs.get(name) != value
    ]
    return f"expected {'; expected '.join(differing)}" if differing else ""
