"""Arrays for the critic alone: who sees them, who does not, and what flies without them."""

from dataclasses import asdict, replace
from typing import Any

import numpy as np
import onnxruntime
import pytest
from nets import arrays_of
from rotorgram.agents import Checkpoint, Config, EpisodeRecorder, make_agent, preset
from rotorgram.agents.episodes import Position
from rotorgram.agents.export import export
from rotorgram.agents.policies import NetworkPolicy, flat
from rotorgram.agents.rollouts import Collector
from rotorgram.envs import LocalVectorEnv, Loop
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.spec import ArraySpec, EnvSpec, SpecError
from rotorgram.models import InputError
from rotorgram.scenes import Solids

FOREST = "rotorgram/Forest-v0"
SMALL: dict[str, Any] = {
    "hidden": (5,), "steps_per_update": 48, "epochs": 1, "minibatches": 1, "max_grad_norm": 1e9,
}  # fmt: skip
NETWORKS: list[dict[str, Any]] = [{}, {"network": "cnn", "filters": (2,)}, {"memory": 3}]
SEEN = slice(20)  # numbers of the flat observation: own motion, depth, and what only critics see
DEPTH = slice(20, 212)
TRUTH = slice(212, 230)


def log_of(**options: Any) -> EpisodeRecorder:
    options = {"backend": "rigid", "privileged": True, **options}
    return EpisodeRecorder(LocalVectorEnv(FOREST, 4, autoreset_mode="Disabled", **options), 3)


def agent_of(algorithm: str = "ppo", **settings: Any) -> tuple[Any, EpisodeRecorder]:
    log = log_of()
    return make_agent(algorithm, log, preset(algorithm, "tuned", FOREST, **settings), 0), log


def test_the_spec_names_them_and_has_them_last() -> None:
    spec = log_of().spec
    assert [(a.name, a.privileged) for a in spec.observation] == [
        ("observation", False), ("depth", False), ("distances", True),
    ]  # fmt: skip
    assert EnvSpec.from_json(spec.to_json()) == spec
    assert [array.name for array in spec.for_actor().observation] == ["observation", "depth"]
    plain = log_of(privileged=False).spec
    assert plain.for_actor() == plain
    assert "privileged" not in plain.to_json().replace('"privileged":false}', "")


@pytest.mark.parametrize("order", [(True,), (True, False)])
def test_an_actor_has_to_see_something_and_first(order: tuple[bool, ...]) -> None:
    arrays = [ArraySpec(name=f"a{i}", shape=(2,), privileged=p) for i, p in enumerate(order)]
    with pytest.raises(SpecError, match="observation: expected at least one array for the actor"):
        replace(log_of().spec, observation=tuple(arrays))


@pytest.mark.parametrize("backend", ["rigid", "mujoco"])
def test_distances_are_those_of_the_scene(backend: str) -> None:
    """At a start, which looks along x; compiled, by NumPy, and by the solids themselves."""
    seen = []
    for compiled in (True, False):
        options = {"backend": {"name": backend, "compiled": compiled}, "privileged": True}
        env = LocalVectorEnv(FOREST, 3, autoreset_mode="Disabled", density=0.3, **options)
        env.reset(seed=5)
        for _ in range(4):
            env.advance(np.full((3, 4), 0.1, np.float32))
        seen.append(env.observations["distances"])
        state = env.loop.record.state
        seeds = env.loop.world.scenery.seeds.tolist()
        env.close()
    assert seen[0].tobytes() == seen[1].tobytes()
    for world, seed in enumerate(seeds):
        w, x, y, z = state.quaternion[world, 0]
        ahead = np.array((1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 0.0))
        ahead /= np.linalg.norm(ahead)
        left = np.array((-ahead[1], ahead[0], 0.0))
        scene = EnvConfig.from_keywords(FOREST, density=0.3).scene.with_seed(seed)
        solids = Solids.of_scene(scene).standing()
        for i, forward in enumerate((0.0, 1.0, 2.0, 3.0, 4.5, 6.0)):
            for j, aside in enumerate((1.5, 0.0, -1.5)[::-1]):
                point = state.position[world, 0] + forward * ahead + aside * left
                expected = np.clip(solids.distance(point), 0.0, 10.0)
                assert seen[0][world, i, j] == pytest.approx(expected, abs=1e-4)


def test_without_solids_all_is_far() -> None:
    config = EnvConfig.from_keywords(FOREST, backend="rigid", scene="plain", privileged=True)
    loop = Loop(config, 2)
    loop.advance(np.zeros((2, 4)), np.ones(2, bool), [0, 1])
    assert (loop.observations["distances"] == 10.0).all()


@pytest.mark.parametrize("settings", NETWORKS)
def test_the_critic_sees_them_and_the_actor_does_not(settings: dict[str, Any]) -> None:
    """By hand: another truth gives other values, and the same actions to the bit."""
    agent, log = agent_of(**SMALL, **settings)
    arrays, gradients = arrays_of(agent)
    log.start()
    observations = log.observations
    other = observations.copy()
    other[:, TRUTH] += 1.0
    before = agent._actor.outputs(observations).copy()
    agent._actor.reset()
    assert agent._actor.outputs(other).tobytes() == before.tobytes()
    values = [agent._values(seen, None) for seen in (observations, other)]
    assert (values[0] != values[1]).all()
    first = "layers.0.weight" if settings.get("network") != "cnn" else "layers.1.weight"
    actor, critic = arrays[f"actor.{first}"], arrays[f"critic.{first}"]
    assert critic.shape[1] - actor.shape[1] == 18
    rollout = agent.collect(Collector(log, np.random.default_rng(0), agent._actor), 48)
    agent.update(rollout)
    both = agent.weights.arrays[first]
    assert not both[0][:, actor.shape[1] :].any()  # of what the actor does not have
    assert abs(gradients[f"critic.{first}"][:, actor.shape[1] :]).max() > 0.0
    assert set(agent._actor.weights.arrays) == set(agent.policy().weights.arrays)


def test_the_actor_learns_the_same_from_any_truth() -> None:
    """Where advantages are given: its gradient does not depend on what only the critic sees."""
    agent, log = agent_of(**SMALL)
    rollout = agent.collect(Collector(log, np.random.default_rng(0), agent._actor), 48)
    columns = agent.columns(rollout)
    _, gradients = arrays_of(agent)
    agent._changes = []
    found = []
    for change in (0.0, 2.0):
        columns[0] = columns[0].copy()
        columns[0][:, TRUTH] += change
        agent.minibatch(*columns)
        found.append({name: gradient.copy() for name, gradient in gradients.items()})
    for name in gradients:
        same = np.array_equal(found[0][name], found[1][name])
        assert same == name.startswith("actor."), name


def test_what_has_no_critic_skips_them() -> None:
    agent, log = agent_of("vpg", episodes_per_update=4)
    assert agent.weights.arrays["layers.0.weight"].shape[2] == 1 + 212
    rollout = agent.collect(Collector(log, np.random.default_rng(0), agent._actor), 400)
    agent.update(rollout)
    assert len(rollout)


def test_a_policy_flies_and_leaves_without_them() -> None:
    agent, _ = agent_of(**SMALL)
    plain = log_of(privileged=False)
    plain.start()
    observation = {name: array[0] for name, array in plain.env.observations.items()}
    policy = agent.policy()
    same = NetworkPolicy.load(policy.weights.arrays, plain.spec, agent.config)
    assert policy.act(observation).tobytes() == same.act(observation).tobytes()
    assert flat(observation, policy.spec, 1).shape == (1, 212)
    position = Position(env_steps=48, seconds=0.0)
    checkpoint = Checkpoint(
        algorithm="ppo", config=asdict(agent.config), spec=agent.spec, seed=0, env_steps=48,
        actor=policy.weights.arrays, state={}, position=position,
    )  # fmt: skip
    header = export(checkpoint, "c").decode()
    assert "#define ROTORGRAM_OBSERVATIONS 212" in header
    assert "distances" not in header
    model = onnxruntime.InferenceSession(export(checkpoint, "onnx"))
    (expected,) = model.run(None, {"observation": flat(observation, policy.spec, 1)})
    assert policy.act(observation) == pytest.approx(expected[0], abs=1e-5)


def test_sb3_is_refused() -> None:
    log = log_of(sensors={})
    config: Config = preset("sb3-ppo", "tuned")
    with pytest.raises(InputError, match="sb3: expected no privileged arrays, which SB3's actor"):
        make_agent("sb3-ppo", log, config, 0)
