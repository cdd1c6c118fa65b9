"""Flights of one policy in many worlds at once, of which only the ends are kept."""

import copy
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..agents.policies import Array, Policy
from ..envs.autoreset import worlds_done
from ..sim.randomize import CASE
from .trajectories import act_each

if TYPE_CHECKING:
    from ..envs.vector import LocalVectorEnv

Columns = dict[str, Array]


def fly_crowd(env: "LocalVectorEnv", policy: Policy, seeds: Sequence[int]) -> Columns:
    """An episode of each world, without exploration: columns with a row for each drone, (N,).

    `seed` of the world; `case`, as of `Randomization`; `length`, control steps; `terminated`;
    `return`; `last`, the last value of the headline metric, and `steady`, its mean size over the
    last quarter of the episode, at least over the last step.

    A policy that flies `many` computes for all drones at once: the last bit of an action may differ
    from that of a drone alone.
    """
    count = env.num_envs
    drones = len(env.env_spec.agents)
    many = getattr(policy, "many", False)
    policies = [policy] if many else [copy.deepcopy(policy) for _ in range(count)]
    for own in policies:
        own.reset()
    of_drones = np.repeat(np.asarray(seeds, np.uint64), drones)
    env.reset(seed=of_drones.tolist())
    cases = env.loop.world.parameters.get(CASE, np.zeros(count)).reshape(count)
    lengths = np.zeros(count, int)
    returns = np.zeros(count)
    terminated = np.zeros(count, bool)
    done = np.zeros(count, bool)
    headlines = []
    while not done.all():
        flying = np.flatnonzero(~done).tolist()
        actions = policy.act(env.observations) if many else act_each(env, policies, flying)
        env.advance(actions, frozen=worlds_done(done, drones))
        headlines.append(env.headline)
        returns += env.rewards
        ended = (env.terminated | env.truncated) & ~done
        terminated |= env.terminated & ended
        lengths[ended] = len(headlines)
        done |= ended
    values = np.array(headlines)
    metric = env.env_spec.headline
    sizes = values if metric and metric.goal == "high" else np.abs(values)
    steady = np.zeros(count)
    for length in np.unique(lengths):
        ended = lengths == length
        steady[ended] = sizes[length - max(1, length // 4) : length, ended].mean(axis=0)
    return {
        "seed": of_drones,
        "case": cases.astype(int),
        "length": lengths,
        "terminated": terminated,
        "return": returns,
        "steady": steady,
        "last": values[lengths - 1, np.arange(count)],
    }
