"""The loop: masks of `advance`, streams of random numbers, and what a task may give."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
from contracts import everyone, loop_of, zero_actions
from gymnasium.utils.env_checker import check_env
from rotorgram.envs import ArraySpec, Loop, Metric, Outcome, Task, register, registry
from rotorgram.models.errors import InputError
from rotorgram.sim import CollectiveThrust, InitialState, stack

ID = "rotorgram/Elevation-v0"
HOVER = "rotorgram/Hover-v0"
one_or_several = pytest.mark.parametrize("num_envs", [1, 3])


def started(env_id: str = ID, num_envs: int = 2, **options: Any) -> tuple[Loop, np.ndarray]:
    """A loop with running episodes, and actions for it."""
    loop = loop_of(env_id, num_envs, **options)
    actions = np.full((num_envs, len(loop.task.controller.low)), 0.4, np.float32)
    loop.advance(actions, everyone(num_envs), range(num_envs))
    return loop, actions


def shown(loop: Loop, drone: int) -> bytes:
    """All that is told of a drone."""
    arrays = [*loop.observations.values(), *loop.telemetry.values()]
    return b"".join(array[drone].tobytes() for array in arrays)


def test_flags_of_those_that_do_not_fly() -> None:
    loop, actions = started(episode_length=1)
    loop.advance(actions)
    assert loop.truncated.tolist() == [True, True]
    assert loop.done.tolist() == [True, True]
    first = np.array([True, False])
    loop.advance(actions, first, None, ~first)
    assert loop.truncated.tolist() == [False, False]
    assert loop.rewards.tolist() == [0.0, 0.0]
    assert loop.done.tolist() == [False, True]
    assert loop.steps.tolist() == [0, 1]


def test_wrong_seeds_are_refused_before_the_others_fly() -> None:
    loop, actions = started()
    with pytest.raises(InputError, match=r"^seed: expected .*, or 2 of them, got \[1\]"):
        loop.advance(actions, np.array([True, False]), [1])
    assert loop.steps.tolist() == [0, 0]


def test_a_first_reset_that_is_refused_begins_nothing() -> None:
    refusals = [InputError("start: expected another one")]

    class Refusing(registry.task_type(ID)):  # type: ignore[misc]
        def begin(self, draw: Any) -> Any:
            if refusals:
                raise refusals.pop()
            return super().begin(draw)

    register("Refusing-v0", Refusing)
    loop = loop_of("Refusing-v0", 2)
    still = zero_actions(2)
    some = np.array([True, False])
    with pytest.raises(InputError, match=r"^start: expected another"):
        loop.advance(still, everyone(2))
    loop.advance(still, some, frozen=~some)
    assert abs(loop.telemetry["position"][:, 2] - 5.0).max() <= 1.0


def test_the_first_reset_may_be_of_some() -> None:
    loop = loop_of(ID, 3)
    every = everyone(3)
    still = zero_actions(3)
    some = np.array([False, True, False])
    loop.advance(still, some, [7, 7, 7], frozen=~some)
    alone = loop_of(ID)
    alone.advance(still[:1], every[:1], [7])
    assert shown(loop, 1) == shown(alone, 0)
    with pytest.raises(gym.error.ResetNeeded, match="env 0 first"):
        loop.advance(still)
    loop.advance(still, ~some, [5, 6, 7])
    loop.advance(still)
    assert loop.steps.tolist() == [1, 2, 1]
    assert loop.record.episodes.ravel().tolist() == [1, 1, 1]


def test_seeds_of_a_wire() -> None:
    """Unsigned numbers of 64 bits, those of drones that are not reset among them."""
    loop, actions = started(num_envs=3)
    before = shown(loop, 1)
    seeds = np.array([2**64 - 1, 5, 2**64 - 1], np.uint64)
    resets = np.array([True, False, True])
    loop.advance(actions, resets, seeds, ~resets)
    assert shown(loop, 1) == before
    assert shown(loop, 0) != before
    assert shown(loop, 2) == shown(loop, 0)


def test_a_draw_that_is_switched_off_moves_no_other() -> None:
    """Equal ends draw all the same: a start tilt of 0 leaves heading and offset as they were."""
    tilted, _ = started(HOVER, start_tilt=30.0)
    level, _ = started(HOVER, start_tilt=0.0)
    np.testing.assert_array_equal(tilted.telemetry["position"], level.telemetry["position"])
    tilts = level.telemetry["attitude"][:, 1:3]
    assert abs(tilts).max() < 1e-12
    headings = level.telemetry["metrics"][:, 1]
    others = tilted.telemetry["metrics"][:, 1]
    np.testing.assert_allclose(others, headings, atol=8.0)


# --- a task that gives whatever a task may give ---------------------------------------------------


class Careless(Task):
    """Gives live arrays of the simulator, an integer picture, and an end that never comes."""

    metrics = (Metric(name="climb", unit="m/s", goal="high"),)

    def setup(self) -> None:
        self.controller = CollectiveThrust(self.vehicle, 10.0, increment=False)
        position = ArraySpec(name="position", shape=(3,), dtype="float64", low=-1e3, high=1e3)
        picture = ArraySpec(name="picture", shape=(2, 2), dtype="uint8")
        self.observation = (position, picture)

    def begin(self, draw: Any) -> InitialState:
        return InitialState(position=stack((0.0, 0.0, draw.uniform(3.0, 4.0))))

    def observe(self, state: Any) -> dict[str, Any]:
        ones = stack((1.0, 2.0, 3.0, state.position[..., 2]))
        return {"position": state.position, "picture": ones.reshape((*ones.shape[:-1], 2, 2))}

    def outcome(self, state: Any) -> Outcome:
        climb = state.velocity[..., 2]
        return Outcome(reward={"climb": climb}, terminated=False, metrics={"climb": climb})


class Counting(Careless):
    """Counts the steps of an episode, in its memory."""

    def begin(self, draw: Any) -> InitialState:
        self.memory.count = 0.0
        return super().begin(draw)

    def update_memory(self, state: Any) -> None:
        self.memory.count = self.memory.count + 1.0

    def outcome(self, state: Any) -> Outcome:
        climb = 0.0 * state.velocity[..., 2]
        count = {"climb": self.memory.count}
        return Outcome(reward={"none": climb}, terminated=False, metrics=count)


@one_or_several
def test_a_tasks_memory_is_that_of_the_drones_that_flew(num_envs: int) -> None:
    register("counting-v0", Counting)
    try:
        loop = loop_of("counting-v0", num_envs)
    finally:
        gym.registry.pop("counting-v0")
    actions = zero_actions(num_envs)
    every = everyone(num_envs)
    first = np.arange(num_envs) == 0
    loop.advance(actions, every, range(num_envs))
    assert loop.metrics["climb"].tolist() == [0.0] * num_envs
    loop.advance(actions)
    loop.advance(actions, frozen=first)
    loop.advance(actions)
    assert loop.metrics["climb"].tolist() == np.where(first, 2.0, 3.0).tolist()
    loop.advance(actions, first, range(num_envs))
    assert loop.metrics["climb"].tolist() == np.where(first, 0.0, 4.0).tolist()


def test_a_task_without_a_method_is_told_which() -> None:
    register("unfinished-v0", type("Unfinished", (Task,), {"setup": Careless.setup}))
    try:
        with pytest.raises(InputError, match=r"methods begin, observe, outcome, got Unfinished"):
            loop_of("unfinished-v0")
    finally:
        gym.registry.pop("unfinished-v0")


@pytest.fixture
def careless() -> Iterator[str]:
    register("careless-v0", Careless)
    yield "careless-v0"
    gym.registry.pop("careless-v0")


@one_or_several
def test_what_a_step_gave_stays_as_it_was(careless: str, num_envs: int) -> None:
    loop = loop_of(careless, num_envs, episode_length=3)
    actions = np.ones((num_envs, 1), np.float32)
    loop.advance(actions, everyone(num_envs), range(num_envs))
    loop.advance(actions)
    given = [*loop.observations.values(), *loop.metrics.values(), *loop.told()()[1].values()]
    given += [loop.rewards, loop.terminated, loop.truncated, *loop.telemetry.values()]
    kept = [array.copy() for array in given]
    loop.advance(actions)
    loop.advance(actions)
    assert loop.truncated.all()
    for array, before in zip(given, kept, strict=True):
        assert array.tobytes() == before.tobytes()
    picture = loop.observations["picture"]
    assert picture.dtype == np.uint8
    assert picture.tolist() == [[[1, 2], [3, 3]]] * num_envs
    assert loop.observations["position"].shape == (num_envs, 3)
    # 40 N on 20 kg: 2 m/s² for 3 steps of 0.02 s
    assert loop.metrics["climb"] == pytest.approx(0.12, abs=1e-9)


@one_or_several
def test_a_task_may_give_constants_and_float32(num_envs: int) -> None:
    class Plain(registry.task_type(ID)):  # type: ignore[misc]
        def begin(self, draw: Any) -> InitialState:
            super().begin(draw)
            return InitialState(position=stack((0.0, 0.0, 4.5 + 0.0 * self.memory.target)))

        def outcome(self, state: Any) -> Any:
            outcome = super().outcome(state)
            height = np.float32(1) * np.asarray(state.position[..., 2], np.float32)
            outcome.reward = {"alive": 1.0, "height": height}
            outcome.metrics = {"elevation_error": 0.25}
            return outcome

    register("Plain-v0", Plain)
    loop = loop_of("Plain-v0", num_envs)
    still = zero_actions(num_envs)
    loop.advance(still, everyone(num_envs))
    loop.advance(still)
    assert loop.rewards.dtype == np.float64
    assert loop.rewards.tolist() == [5.5] * num_envs
    assert loop.told()()[1]["alive"].tolist() == [1.0] * num_envs
    assert loop.metrics["elevation_error"].tolist() == [0.25] * num_envs
    assert loop.telemetry["metrics"].tolist() == [[0.25]] * num_envs


def test_several_arrays_are_a_dict(careless: str) -> None:
    env = gym.make(careless, disable_env_checker=True)
    check_env(env.unwrapped, skip_render_check=True)
    observation, info = env.reset(seed=0)
    assert set(observation) == {"position", "picture"}
    assert "goal_x" not in info
    many = gym.make_vec(careless, num_envs=2)
    seen, _ = many.reset(seed=0)
    assert seen["position"][0].tobytes() == observation["position"].tobytes()


def test_ids() -> None:
    assert registry.is_known(ID)
    assert registry.is_known(HOVER)
    assert registry.is_known(f"rotorgram.envs:{ID}")
    with pytest.raises(InputError, match=r"^env: expected a registered id .*, got 'CartPole-v1'"):
        loop_of("CartPole-v1")
    with pytest.raises(InputError, match=r"^env id: expected one that is free, got 'CartPole-v1'"):
        register("CartPole-v1", Careless)
    for wrong in ("landing", "my landing-v0", 3):
        with pytest.raises(InputError, match=r"^env id: expected name-v0"):
            register(wrong, Careless)  # type: ignore[arg-type]


def test_what_a_user_typed_is_imported_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "typed_here.py").write_text(
        "from rotorgram.envs import Task, register\nregister('Typed-v0', Task)\n"
    )
    assert not registry.is_known("typed_here:Typed-v0")
    with pytest.raises(InputError, match=r"^env: expected a registered id"):
        registry.task_type("typed_here:Typed-v0")
    assert registry.load("typed_here:Typed-v0") == "Typed-v0"
    assert registry.task_type("Typed-v0") is Task
    assert registry.load(ID) == ID
    (tmp_path / "colorsys.py").write_text("raise AssertionError('not the installed one')\n")
    with pytest.raises(InputError, match=r"^env: expected colorsys to register Typed-v1"):
        registry.load("colorsys:Typed-v1")
    with pytest.raises(InputError, match=r"^env: expected typed_here to register Other-v0"):
        registry.load("typed_here:Other-v0")
    with pytest.raises(InputError, match=r"^env: expected a module nowhere here, got none"):
        registry.load("nowhere:Typed-v0")
    (tmp_path / "lacking_task.py").write_text("import lacking\n")
    with pytest.raises(ModuleNotFoundError, match=r"^No module named 'lacking'$"):
        registry.load("lacking_task:Typed-v0")
    gym.registry.pop("Typed-v0")


@one_or_several
@pytest.mark.parametrize("wrong", ["observation", "reward"])
def test_numbers_of_a_task_that_are_not_finite_go_no_further(num_envs: int, wrong: str) -> None:
    class Broken(registry.task_type(ID)):  # type: ignore[misc]
        def observe(self, state: Any) -> Any:
            seen = super().observe(state)["observation"]
            if wrong == "observation":
                seen = seen * np.nan
            return {"observation": seen}

        def outcome(self, state: Any) -> Any:
            outcome = super().outcome(state)
            added = np.nan if wrong == "reward" else 0.0
            outcome.reward = {name: x + added for name, x in outcome.reward.items()}
            return outcome

    register("Broken-v0", Broken)
    loop = loop_of("Broken-v0", num_envs)
    everybody = everyone(num_envs)
    with pytest.raises(InputError, match=rf"Broken-v0: expected finite numbers for {wrong}"):
        loop.advance(zero_actions(num_envs), everybody)


@one_or_several
@pytest.mark.parametrize(
    ("start", "got"),
    [
        (None, "NoneType"),
        (np.zeros(3), "ndarray"),
        (InitialState(position=[0.0, 0.0, 3.0]), r"\(\)"),
        (InitialState(position=np.zeros(2)), r"\(2,\)"),
    ],
)
def test_a_start_that_is_none(num_envs: int, start: Any, got: str) -> None:
    class Lost(registry.task_type(ID)):  # type: ignore[misc]
        def begin(self, draw: Any) -> Any:
            return start

    register("Lost-v0", Lost)
    loop = loop_of("Lost-v0", num_envs)
    sentence = (
        rf"^Lost-v0: expected begin\(\) to return an InitialState with a position of .*, got {got}$"
    )
    with pytest.raises(InputError, match=sentence):
        loop.advance(zero_actions(num_envs), everyone(num_envs))


# --- what a task sees, and what it remembers ------------------------------------------------------


class Watching(Careless):
    """Keeps the states that it sees."""

    seen: ClassVar[list[Any]] = []

    def outcome(self, state: Any) -> Outcome:
        self.seen.append(state)
        return super().outcome(state)


def looped(task: type[Task], num_envs: int) -> tuple[Loop, np.ndarray]:
    register("looped-v0", task)
    try:
        loop = loop_of("looped-v0", num_envs)
    finally:
        gym.registry.pop("looped-v0")
    loop.advance(zero_actions(num_envs), everyone(num_envs), range(num_envs))
    return loop, np.full((num_envs, 1), 0.5, np.float32)


@one_or_several
def test_states_are_safe_to_keep(num_envs: int) -> None:
    """A task that kept `state.thrust` once saw the simulator's memory (fault 43)."""
    Watching.seen.clear()
    loop, actions = looped(Watching, num_envs)

    def height(state: Any) -> Any:
        return state.position[..., 2].tolist()

    heights = [height(loop.record.state)]
    for _ in range(3):
        loop.advance(actions)
        heights.append(height(loop.record.state))
    seen = [height(state) for state in Watching.seen]
    assert seen == heights
    different = {str(row) for row in heights}
    assert len(different) == 4
    first, second = Watching.seen[:2]
    added = second.thrust - first.thrust
    assert np.ptp(added) == 0.0
    assert added.flat[0] == 5.0  # 10 N for an action of 1
    with pytest.raises(ValueError, match="read-only"):
        first.position[..., 2] = 0.0


@one_or_several
def test_a_task_sees_action_and_time(num_envs: int) -> None:
    Watching.seen.clear()
    loop, actions = looped(Watching, num_envs)
    loop.advance(actions)
    loop.advance(actions)
    drones = np.arange(num_envs)
    loop.advance(actions, drones == 0, None, drones > 0)
    sent = [np.ravel(state.action)[0] for state in Watching.seen]
    assert sent == [0.0, 0.5, 0.5, 0.0]
    steps = [np.ravel(state.steps)[0] for state in Watching.seen]
    assert steps == [0, 1, 2, 0]
    times = [np.ravel(state.time)[0] for state in Watching.seen]
    assert times == [0.0, 0.02, 0.04, 0.0]
    last = np.ravel(Watching.seen[-1].action)
    assert last[1:].tolist() == [0.5] * (num_envs - 1)


def test_a_task_remembers_in_its_memory_alone() -> None:
    class Forgetful(Careless):
        def outcome(self, state: Any) -> Outcome:
            self.last = state.thrust
            return super().outcome(state)

    with pytest.raises(AttributeError, match=r"^Forgetful.last: expected self.memory.last = "):
        looped(Forgetful, 2)

    class Late(Careless):
        def update_memory(self, state: Any) -> None:
            self.memory.count = 1.0

    loop, actions = looped(Late, 2)
    with pytest.raises(AttributeError, match=r"^memory.count: expected a value from begin\(\)"):
        loop.advance(actions)

    class Writing(Counting):
        def observe(self, state: Any) -> dict[str, Any]:
            self.memory.count = 2.0
            return super().observe(state)

    with pytest.raises(AttributeError, match=r"^memory.count: expected to be set in begin\(\)"):
        looped(Writing, 2)
