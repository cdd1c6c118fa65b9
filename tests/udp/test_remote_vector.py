"""Many drones of one or several simulators as one vector env: parity, interface, autoreset."""

from contextlib import closing
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from fleets import NAMES, Failing, assert_parity, assert_same, flying, sync
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from peers import ANY, ENV_ID, plain_socket, simulate
from rotorgram.envs import LocalVectorEnv
from rotorgram.udp import (
    PeerSilent,
    RemoteVectorEnv,
)

# ---- parity


@pytest.mark.parametrize("simulators", [1, 3])
@pytest.mark.parametrize("drones", [1, 4])
def test_parity(simulators: int, drones: int) -> None:
    options = {"episode_length": 23, "target": (4.0, 6.0)}
    number = simulators * drones
    with flying(simulators, drones, **options) as (remote, _), sync(number, **options) as local:
        for seed in (0, [2**63 + 5 * i for i in range(number)], [7] * number):
            assert_same(remote.reset(seed=seed), local.reset(seed=seed))
            assert assert_parity(remote, local, 80) >= 3 * number
        assert_same(remote.reset(), local.reset())  # the generators go on
        assert assert_parity(remote, local, 30) >= number


def test_parity_of_episodes_that_end_at_different_times() -> None:
    options = {"action_type": "discrete", "flight_band": 1.2, "episode_length": 60}
    with flying(3, 2, **options) as (remote, _), sync(6, **options) as local:
        assert_same(remote.reset(seed=1), local.reset(seed=1))
        assert remote.single_action_space == spaces.Discrete(3)
        assert remote.action_space == local.action_space
        assert assert_parity(remote, local, 500) > 40


def pole() -> gym.Env[Any, Any]:
    return gym.make("CartPole-v1")


def test_another_env_of_gymnasium_flies_too() -> None:
    local = gym.make_vec("CartPole-v1", num_envs=4, vectorization_mode="sync")
    with flying(4, 1, env=pole) as (remote, _), closing(local):
        assert_same(remote.reset(seed=3), local.reset(seed=3))
        dice = np.random.default_rng(0)
        for _ in range(100):
            actions = dice.integers(2, size=4)
            here = remote.step(actions)
            there = local.step(actions)
            assert_same((*here[:1], *here[2:]), (*there[:1], *there[2:]))
            # Gymnasium's own are float64 as well; CartPole's are whole.
            assert here[1].tolist() == there[1].tolist()
            assert here[4] == {}


# ---- Gymnasium's interface


@pytest.mark.parametrize("options", [{}, {"action_type": "discrete", "observation": "error"}])
def test_spaces_and_metadata(options: dict[str, Any]) -> None:
    with flying(2, 2, control_period=0.04, **options) as (remote, _), sync(4, **options) as local:
        remote.reset()
        assert isinstance(remote, VectorEnv)
        assert remote.num_envs == 4
        assert remote.action_space == local.action_space
        assert remote.single_action_space == local.single_action_space
        assert remote.observation_space == batch_space(remote.single_observation_space, 4)
        assert remote.single_observation_space.shape == local.single_observation_space.shape
        assert remote.metadata == {
            "render_modes": [],
            "render_fps": 25,
            "autoreset_mode": AutoresetMode.NEXT_STEP,
        }
        assert remote.render_mode is None
        assert remote.unwrapped is remote
        assert repr(remote) == "RemoteVectorEnv(num_envs=4)"


def test_what_a_step_gives_is_the_callers() -> None:
    with flying(1, 2) as (remote, _), sync(2) as local:
        assert_same(remote.reset(seed=0), local.reset(seed=0))
        for _ in range(5):
            here = remote.step(np.ones((2, 1)))
            there = local.step(np.ones((2, 1), np.float32))
            assert_same(here, there)
            for array in (*here[:4], *here[4].values()):
                array[...] = 1  # changes nothing of the next step, nor of another array
            assert here[0].sum() == 6


def test_the_first_simulator_says_how_many_drones_there_are() -> None:
    with plain_socket() as sock:
        address = sock.getsockname()
    running = [simulate(address, num_envs=3) for _ in range(2)]
    with closing(RemoteVectorEnv(address, num_simulators=2)) as remote:
        assert remote.num_envs == 6
        assert remote.num_simulators == 2
        assert remote.observation_space.shape == (6, 3)
        assert remote.statistics.counters["sessions"] == 2
    assert [one.join() for one in running] == ["the agent closed"] * 2


def test_seeded_spaces_stay_seeded() -> None:
    with flying(1, 2) as (remote, _):
        samples = []
        remote.connect()
        for _ in range(2):
            remote.action_space.seed(3)
            remote.reset()
            samples.append(remote.action_space.sample().tolist())
        assert samples[0] == samples[1]


# ---- what the caller does wrong


def test_steps_at_the_wrong_time() -> None:
    actions = np.zeros((2, 1))
    with flying(1, 2) as (remote, _):
        with pytest.raises(gym.error.ResetNeeded, match="step: expected a call of reset"):
            remote.step(actions)
        remote.reset()
        remote.step(actions)
        remote.close()
        remote.close()
        with pytest.raises(gym.error.ResetNeeded):
            remote.step(actions)
        with pytest.raises(gym.error.ClosedEnvironmentError, match="expected an open env"):
            remote.reset()


@pytest.mark.parametrize(
    ("actions", "sentence"),
    [
        (np.zeros(4), r"actions: expected shape \(4, 1\), got \(4,\)"),
        (np.zeros((2, 1)), r"actions: expected shape \(4, 1\), got \(2, 1\)"),
        (0.0, r"actions: expected shape \(4, 1\), got \(\)"),
        ([[0.0], [0.0], [0.0], [np.nan]], "actions: expected finite numbers"),
        ([[0.0], [0.0], [np.inf], [0.0]], "actions: expected finite numbers"),
        ([[0.0], [0.0], [1e300], [0.0]], "actions: expected finite numbers"),
    ],
)
def test_wrong_actions_raise_and_nothing_has_happened(actions: Any, sentence: str) -> None:
    with flying(2, 2) as (remote, _), sync(4) as local:
        assert_same(remote.reset(seed=1), local.reset(seed=1))
        sent = remote.statistics.counters["sent"]
        with pytest.raises(ValueError, match=sentence):
            remote.step(actions)
        assert remote.statistics.counters["sent"] == sent
        good = np.full((4, 1), 0.5, np.float32)
        assert_same(remote.step(good), local.step(good))


def test_wrong_discrete_actions() -> None:
    with flying(1, 2, action_type="discrete") as (remote, _):
        remote.reset()
        for actions in ([0, 3], [-1, 0], [0.5, 1], [np.nan, 1]):
            with pytest.raises(ValueError, match="actions: expected"):
                remote.step(np.array(actions))
        remote.step(np.array([0, 2]))


@pytest.mark.parametrize("seed", [-1, 2**64 - 3, [1, 2, 3], [1, 2, 3, -1], [1, 2, 3, 2**64],
                                  [1, 2, 3, 0.5], [1, 2, 3, None], 0.5, "1234",
                                  np.array(3)])  # fmt: skip
def test_wrong_seeds(seed: Any) -> None:
    with flying(2, 2) as (remote, _), sync(4) as local:
        seeds = [0, 2**64 - 1, 5, 5]
        assert_same(remote.reset(seed=seeds), local.reset(seed=seeds))
        sent = remote.statistics.counters["sent"]
        sentence = r"seed: expected a whole number from 0 to 2\^64 - 1, or 4 of them, got"
        with pytest.raises(ValueError, match=sentence):
            remote.reset(seed=seed)
        if np.ndim(seed):
            with pytest.raises(ValueError, match=sentence):
                remote.advance(np.zeros((4, 1)), np.ones(4, bool), seed)
        with pytest.raises(ValueError, match="options: expected some of reset_mask, got 'target'"):
            remote.reset(options={"target": 5.0})
        assert remote.statistics.counters["sent"] == sent
        actions = np.full((4, 1), 0.5, np.float32)  # the episodes go on
        assert_same(remote.step(actions), local.step(actions))
        remote.reset(seed=2**64 - 4)


# ---- autoreset


@pytest.mark.parametrize("drones", [1, 3])
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_autoreset_is_that_of_the_local_env(mode: str, drones: int) -> None:
    options: dict[str, Any] = {"episode_length": 12, "flight_band": 1.3}
    local = LocalVectorEnv(ENV_ID, 2 * drones, autoreset_mode=mode, **options)
    with flying(2, drones, autoreset=mode, **options) as (remote, _):
        assert remote.metadata["autoreset_mode"] == local.metadata["autoreset_mode"]
        assert_same(remote.reset(seed=4), local.reset(seed=4))
        dice = np.random.default_rng(2)
        ended = 0
        for _ in range(80):
            actions = dice.uniform(-1, 1, (2 * drones, 1)).astype(np.float32)
            here = remote.step(actions)
            there = local.step(actions)
            assert_same(here, there)
            assert here[4].keys() <= there[4].keys()
            if "final_obs" in there[4]:
                flags = here[4]["_final_obs"]
                ended += flags.sum()
                assert flags.tobytes() == there[4]["_final_obs"].tobytes()
                finals = [env[4]["final_info"] for env in (here, there)]
                assert here[4]["final_obs"].tobytes() == there[4]["final_obs"].tobytes()
                for name in NAMES:
                    assert finals[0][name][flags].tobytes() == finals[1][name][flags].tobytes()
                    assert (finals[0][f"_{name}"] == flags).all()
        assert (ended > 0) == (mode == "SameStep")


def test_a_mask_resets_some_and_the_others_hold() -> None:
    local = LocalVectorEnv(ENV_ID, 4, autoreset_mode="Disabled")
    with flying(2, 2, autoreset="Disabled") as (remote, _):
        assert_same(remote.reset(seed=1), local.reset(seed=1))
        dice = np.random.default_rng(0)
        for number in range(20):
            actions = dice.uniform(-1, 1, (4, 1)).astype(np.float32)
            assert_same(remote.step(actions), local.step(actions))
            mask = np.array([[True, False, False, False], [False, True, True, False]][number % 2])
            masked = [
                env.reset(seed=[number, 1, 2, 3], options={"reset_mask": mask.copy()})
                for env in (remote, local)
            ]
            assert_same(*masked)
            assert (masked[0][1]["_z"] == mask).all()
        with pytest.raises(ValueError, match="reset_mask: expected an array of 4 bool"):
            remote.reset(options={"reset_mask": np.zeros(4, bool)})


def test_a_drone_of_both_masks_is_reset() -> None:
    local = LocalVectorEnv(ENV_ID, 2, autoreset_mode="Disabled")
    resets = np.array([True, False])
    frozen = np.array([True, True])
    with flying(1, 2, autoreset="Disabled") as (remote, _):
        for env in (remote, local):
            env.reset(seed=1)
            env.step(np.full((2, 1), 0.5, np.float32))
            env.advance(np.zeros((2, 1), np.float32), resets, [7, 8], frozen)
        assert remote.observations.tobytes() == local.observations.tobytes()
        assert (remote.observations[:, 1] == 0.0).tolist() == [True, False], "velocities"


def test_a_mask_before_the_first_reset_leaves_the_others_to_be_reset() -> None:
    local = LocalVectorEnv(ENV_ID, 4)
    actions = np.full((4, 1), 0.5, np.float32)
    some = {"reset_mask": np.array([False, True, False, False])}
    rest = {"reset_mask": ~some["reset_mask"]}
    with flying(2, 2) as (remote, _):
        for env in (remote, local):
            _, info = env.reset(seed=3, options=some)
            assert info["_z"].tolist() == [False, True, False, False]
            with pytest.raises(gym.error.ResetNeeded, match="for env 0 first"):
                env.step(actions)
        assert_same(remote.reset(seed=3, options=rest), local.reset(seed=3, options=rest))
        for _ in range(5):
            assert_same(remote.step(actions), local.step(actions))


def test_a_mask_after_an_error_leaves_the_others_to_be_reset() -> None:
    env = Failing(gym.make(ENV_ID, disable_env_checker=True))
    remote = RemoteVectorEnv(ANY, num_simulators=2, num_envs=2, connect=False, connect_timeout=1)
    with closing(remote):
        running = [simulate(remote, env=env), simulate(remote)]
        remote.reset()
        env.fails = True
        with pytest.raises(PeerSilent, match="no other"):
            remote.step(np.zeros((2, 1)))
        running.append(simulate(remote))
        for number in (0, 1):
            with pytest.raises(gym.error.ResetNeeded):
                remote.step(np.zeros((2, 1)))
            remote.reset(options={"reset_mask": np.arange(2) == number})
        remote.step(np.zeros((2, 1)))
    assert str(running.pop(0).join()) == "out of fuel"
    assert [one.join() for one in running] == ["the agent closed"] * 2


def test_who_waits_for_a_reset_loses_no_episode_with_its_simulator() -> None:
    first = {"reset_mask": np.array([True, False])}
    with flying(1, 2) as (remote, running):
        remote.reset(options=first)
        here = running[0].simulator.address
        running[0].cut()
        running[0] = simulate(remote, bind=here, num_envs=2)
        _, info = remote.reset(options=first)
        assert remote.statistics.counters["sessions"] == 2
        assert "simulator_lost" not in info
        with pytest.raises(gym.error.ResetNeeded, match="for env 1 first"):
            remote.step(np.zeros((2, 1)))


def test_who_has_ended_and_holds_is_not_forgotten() -> None:
    options: dict[str, Any] = {"start_band": 0.3, "flight_band": 0.4}
    local = LocalVectorEnv(ENV_ID, 2, **options)
    with flying(1, 2, **options) as (remote, _):
        assert_same(remote.reset(seed=1), local.reset(seed=1))
        actions = np.array([[1.0], [0.0]], np.float32)
        while not local.done.any():
            assert_same(remote.step(actions), local.step(actions))
        assert local.done.tolist() == [True, False]
        others = {"reset_mask": np.array([False, True])}
        assert_same(remote.reset(seed=7, options=others), local.reset(seed=7, options=others))
        for _ in range(3):  # the first resets drone 0
            assert_same(remote.step(actions), local.step(actions))


def test_a_step_after_the_end_without_autoreset_changes_nothing() -> None:
    with flying(1, 2, autoreset="Disabled", episode_length=2) as (remote, _):
        remote.reset(seed=0)
        hold = np.zeros((2, 1), np.float32)
        remote.step(hold)
        assert remote.step(hold)[3].all()
        with pytest.raises(gym.error.ResetNeeded, match="for env 0 first"):
            remote.step(hold)
        remote.reset(options={"reset_mask": np.ones(2, bool)})
        assert not remote.step(hold)[3].any()


def test_states_larger_than_the_systems_buffer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rotorgram.udp.transport.sockets._BUFFER", 212_992)  # Linux's own limit
    local = LocalVectorEnv(ENV_ID, 5000)
    with flying(1, 5000) as (remote, _):
        assert_same(remote.reset(seed=1), local.reset(seed=1))
        actions = np.full((5000, 1), 0.1, np.float32)
        for _ in range(3):
            assert_same(remote.step(actions), local.step(actions))


def test_an_env_of_others_is_held_too() -> None:
    with flying(2, 1, env=pole, autoreset="SameStep") as (remote, _):
        remote.reset(seed=0)
        push = np.array([1, 0])
        for _ in range(60):
            observations, _, terminated, _, info = remote.step(push)
            if terminated.any():
                assert (info["_final_obs"] == terminated).all()
                assert (abs(observations[terminated]) < 0.05).all()
                push = push[::-1]
