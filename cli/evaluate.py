"""`rotorgram evaluate`: fly episodes without exploration, print the means."""

from typing import TYPE_CHECKING

import numpy as np

from ..experiments.evaluate import evaluation_row, fly_episodes
from .inputs import load_policy, remote_env

if TYPE_CHECKING:
    from .flying import Evaluate

__all__ = ["evaluate"]


def evaluate(command: "Evaluate") -> int:
    """Fly and print the means; the exit status."""
    if command.episodes < 1:
        raise ValueError(f"episodes: expected at least 1, got {command.episodes}")
    policy, config = load_policy(command.policy, command.env.checked())
    with remote_env(config, command) as env:
        flights = fly_episodes(env, policy, command.episodes)
    rows = [evaluation_row(f, k, config.control_period) for k, f in enumerate(flights)]
    settled = [r["settling_time"] for r in rows if not np.isnan(r["settling_time"])]
    crashes = sum(r["terminated"] for r in rows)
    settling = f"{np.mean(settled):.2f} s" if settled else "never"
    print(f"policy            {command.policy}")
    print(f"episodes          {len(rows)}, {crashes} terminated")
    print(f"return            {np.mean([r['return'] for r in rows]):.1f}")
    print(f"steady-state |E|  {np.mean([r['steady_error'] for r in rows]):.4f} m")
    print(f"settling to 5 cm  {settling} ({len(settled)} of {len(rows)} episodes)")
    print(f"overshoot         {np.mean([r['overshoot'] for r in rows]):.3f} m")
    return 0
