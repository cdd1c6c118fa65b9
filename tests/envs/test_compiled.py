"""The loop as machine code: the same bits as NumPy, in whatever way it is used; and what fails."""

import builtins
import json
import logging
import pickle
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from contracts import CASES, HASHES, HOVER, RIGID, STEPS, WORLDS, Case, bits, flight, hash_of
from rotorgram.envs import Loop, registry
from rotorgram.envs.compiled import CompiledLoop, make_loop
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import register
from rotorgram.envs.vector import LocalVectorEnv
from rotorgram.models import InputError
from rotorgram.sim import PhysicsError
from rotorgram.sim.compile import llvm

EXPECTED = json.loads(HASHES.read_text())
BY_NUMPY = [name for name, case in RIGID.items() if case.options.get("compiled") is False]
MUJOCO = [
    name
    for name, case in CASES.items()
    if case.config().backend.name == "mujoco" and "cameras" not in case.options
]
MANY = 150  # worlds: two blocks, and a part of one


def both(case: Case, worlds: int = WORLDS, **more: Any) -> tuple[CompiledLoop, Loop]:
    config = case.config(**more)
    compiled = make_loop(config, worlds)
    assert isinstance(compiled, CompiledLoop)
    plain = Loop(config, worlds)
    plain.world.random.keys = compiled.world.random.keys  # until they are seeded
    return compiled, plain


def check_same(ours: CompiledLoop, theirs: Loop) -> None:
    """All arrays that a later step depends on, and what the last step gave."""
    assert ours.machine()
    for name in ("observations", "rewards", "terminated", "truncated", "done", "out"):
        assert bits(getattr(ours, name)) == bits(getattr(theirs, name)), name
    assert bits(ours.telemetry) == bits(theirs.telemetry)
    assert bits(ours.told()()[1]) == bits(theirs.told()()[1])
    found = ours.snapshot()
    for name, expected in theirs.snapshot().items():
        assert bits(found[name]) == bits(expected), name


@pytest.mark.parametrize("name", [name for name in RIGID if name not in BY_NUMPY])
def test_the_bits_of_numpy_and_of_every_processor(name: str) -> None:
    """With worlds that are reset in mid-flight, that rest, and whose episodes end.

    `python tests/contracts.py` writes the hashes anew.
    """
    ours, theirs = both(RIGID[name])
    flown = []
    for step in range(STEPS):
        flown += flight(ours, range(step, step + 1))
        flight(theirs, range(step, step + 1))
        check_same(ours, theirs)
    assert hash_of(flown) == EXPECTED[name]


def test_drones_of_different_vehicles_are_compiled() -> None:
    config = EnvConfig(
        env_id="rotorgram/Formation-v0", vehicle=("crazyflie2", "skydio_x2"), drones=2
    )
    ours, theirs = make_loop(config, WORLDS), Loop(config, WORLDS)
    for step in range(STEPS):
        for loop in (ours, theirs):
            flight(loop, range(step, step + 1))
        check_same(ours, theirs)


@pytest.mark.parametrize("name", MUJOCO)
def test_the_bits_of_numpy_on_mujoco(name: str) -> None:
    """Code before and after the physics, and where it is split."""
    ours, theirs = both(CASES[name])
    for step in range(STEPS):
        for loop in (ours, theirs):
            flight(loop, range(step, step + 1))
        if step % 4 == 3:
            check_same(ours, theirs)


@pytest.mark.parametrize("name", BY_NUMPY)
def test_a_vehicle_has_the_bits_of_every_processor(name: str) -> None:
    """Also its numbers are derived alike."""
    assert hash_of(flight(Loop(RIGID[name].config(), WORLDS))) == EXPECTED[name]


def test_every_flight_has_a_hash() -> None:
    assert EXPECTED.keys() == RIGID.keys()


@pytest.mark.parametrize("name", ["Hover, rotors, rigid", "Tracking, rotors, rigid", "rich, rigid"])
def test_the_bits_of_numpy_in_float64_and_many_blocks(name: str) -> None:
    ours, theirs = both(CASES[name], MANY, dtype="float64")
    draw = np.random.default_rng(0)
    seeds = np.arange(MANY)
    resets = seeds >= 0
    width = len(theirs.task.controller.low)
    for _ in range(STEPS):
        frozen = draw.random(MANY) < 0.1
        actions = draw.uniform(-1.0, 1.0, (MANY, width)).astype(np.float32)
        for loop in (ours, theirs):
            loop.advance(actions, resets & ~frozen, seeds, frozen)
        check_same(ours, theirs)
        resets = theirs.record.waiting[:, 0] | (draw.random(MANY) < 0.1)


def test_a_first_reset_of_some_worlds() -> None:
    ours, theirs = both(CASES["Hover, rotors, rigid"])
    some = np.array([False, True, False])
    for loop in (ours, theirs):
        loop.advance(np.zeros((WORLDS, 4), np.float32), some, [5, 6, 7], ~some)
    check_same(ours, theirs)
    with pytest.raises(gym.error.ResetNeeded):
        ours.advance(np.zeros((WORLDS, 4), np.float32))


def test_numpy_and_machine_take_turns() -> None:
    """Who reads the world gets the state, and the next step begins there."""
    ours, theirs = both(CASES["rich, rigid"])
    flight(ours, range(6))
    flight(theirs, range(6))
    assert bits(ours.world.state.position) == bits(theirs.world.state.position)
    other = Loop(theirs.config, WORLDS)
    other.restore(ours.snapshot())
    for loop in (ours, theirs, other):
        flight(loop, range(6, 12))
    check_same(ours, theirs)
    assert bits(other.snapshot()) == bits(theirs.snapshot())
    ours.restore(other.snapshot())
    copied = pickle.loads(pickle.dumps(ours))  # of our own making
    for loop in (ours, theirs, copied):
        flight(loop, range(12, STEPS))
    check_same(ours, theirs)
    check_same(copied, theirs)


def test_bad_states_and_numbers_are_told_of() -> None:
    env = LocalVectorEnv(HOVER, 3, backend="rigid")
    env.reset(seed=1)
    env.loop.world.state.velocity[1, 0, 2] = 1e12
    with pytest.raises(PhysicsError, match=r"bad states in envs \[1\]"):
        env.step(np.zeros((3, 4), np.float32))
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros((3, 4), np.float32))
    env.reset()
    env.step(np.zeros((3, 4), np.float32))


def test_a_bad_step_is_not_counted() -> None:
    ours, theirs = both(Case(HOVER, {"backend": "rigid"}))
    for loop in (ours, theirs):
        loop.advance(None, np.ones(WORLDS, bool), range(WORLDS))
        loop.advance(np.zeros((WORLDS, 4), np.float32))
        loop.world.state.velocity[1, 0, 2] = 1e12
        with pytest.raises(PhysicsError):
            loop.advance(np.zeros((WORLDS, 4), np.float32))
    assert ours.steps.tolist() == theirs.steps.tolist() == [1] * WORLDS


def test_a_start_that_is_refused_changes_nothing() -> None:
    """A payload would hang in the ground: physics says so after the code has drawn the start."""
    options = {"effects": {"payload": 1.0, "cable": 4.8}, "start_band": 1.0}
    ours, theirs = both(Case(HOVER, options))
    actions = np.zeros((WORLDS, 4), np.float32)
    everybody = np.ones(WORLDS, bool)
    refused = []
    for seed in range(20):
        for loop in (ours, theirs):
            try:
                loop.advance(actions, everybody, [seed] * WORLDS)
            except InputError as error:
                refused.append((seed, str(error)))
        if theirs.record.has_begun:
            check_same(ours, theirs)
    assert len(refused) == 2 * len(set(refused))
    assert 5 < len(set(refused)) < 20
    assert all(told.startswith("start: expected a height over") for _, told in refused)


def test_a_start_that_is_refused_lets_the_others_fly() -> None:
    """Their next action meets the state that they have then, and their step is counted."""
    options = {"effects": {"payload": 1.0, "cable": 4.8}, "start_band": 1.0, "action": "attitude"}
    ours, theirs = both(Case(HOVER, options))
    actions = np.zeros((WORLDS, 4), np.float32)
    first = np.arange(WORLDS) == 0
    refused = 0
    for loop in (ours, theirs):
        loop.advance(actions, first | True, [8, 9, 10])
        refused = 0
        for seed in range(6):
            try:
                loop.advance(actions, first, [seed] * WORLDS)
            except InputError:
                refused += 1
    assert 0 < refused < 6
    check_same(ours, theirs)
    assert ours.steps[1] == 6


def test_an_error_in_the_middle_of_a_step_leaves_the_state_of_the_physics(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also the seeds of worlds that did not begin for it."""
    ours, theirs = both(Case(HOVER, {"action": "attitude"}))
    actions = np.full((WORLDS, 4), 0.1, np.float32)
    last = np.arange(WORLDS) == 2
    for loop in (ours, theirs):
        loop.advance(actions, last | True, [1, 2, 3])
        loop.advance(actions)
        world = loop.world
        fly = world.fly

        def interrupted(*given: Any, fly: Any = fly) -> None:
            fly(*given)
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(world, "fly", interrupted)
            with pytest.raises(KeyboardInterrupt):
                loop.advance(actions)
        loop.advance(actions)
    assert bits(ours.observations) == bits(theirs.observations)
    for loop in (ours, theirs):
        loop.world.state.velocity[0] = np.nan
        with pytest.raises(PhysicsError):
            loop.advance(actions, last, [7, 7, 7])
        loop.advance(actions, last | True)
    check_same(ours, theirs)


@pytest.mark.parametrize("backend", ["mujoco", "rigid"])
def test_a_loop_that_is_prepared_has_no_episode_yet(backend: str) -> None:
    ours, theirs = both(Case(HOVER, {"backend": backend}))
    ours.prepare()
    assert not ours.record.has_begun
    ours.prepare()
    assert ours.snapshot().keys() == theirs.snapshot().keys()
    first = np.arange(WORLDS) == 0
    for loop in (ours, theirs):
        with pytest.raises(gym.error.ResetNeeded, match=r"expected a call of reset\(\) first"):
            _ = loop.telemetry
        loop.advance(np.zeros((WORLDS, 4), np.float32), first, None, ~first)
    check_same(ours, theirs)
    before = ours.snapshot()
    ours.restore(before)
    before["Flight/state/thrust"] += 1.0
    check_same(ours, theirs)
    ours.advance(np.zeros((WORLDS, 4), np.float32), ~first, None, first)
    ours.close()
    assert np.array_equal(ours.steps, [0, 0, 0])


class Branching(registry.task_type(HOVER)):  # type: ignore[misc]
    """A task with a branch on an array."""

    def outcome(self, state: Any) -> Any:
        """As of Hover."""
        if state.position[0, 0, 2] > 0:
            return super().outcome(state)
        return None


class Named(registry.task_type(HOVER)):  # type: ignore[misc]
    """Its arrays have names of the loop's, and one that LLVM would not take."""

    names = ("reward", "done", "sent", "record/kept/steps", 'a"b')

    def setup(self) -> None:
        """As of Hover."""
        super().setup()
        self.observation = tuple(replace(self.observation[0], name=name) for name in self.names)

    def observe(self, state: Any) -> Any:
        """As of Hover."""
        (values,) = super().observe(state).values()
        return dict.fromkeys(self.names, values)


def test_a_task_names_its_arrays() -> None:
    register("Named-v0", Named)
    ours, theirs = both(Case("Named-v0").on_rigid())
    for loop in (ours, theirs):
        flight(loop, range(STEPS))
    check_same(ours, theirs)


def test_what_cannot_be_compiled_flies_by_numpy_and_is_said(
    caplog: pytest.LogCaptureFixture,
) -> None:
    register("Branching-v0", Branching)
    loop = make_loop(EnvConfig.from_keywords("Branching-v0", backend="rigid"), WORLDS)
    with caplog.at_level(logging.WARNING):
        flight(loop, range(3))
    (line,) = [record.getMessage() for record in caplog.records]
    assert line.startswith("Branching-v0: not compiled, NumPy flies it: a branch on an array")
    assert "`outcome`, line " in line
    theirs = Loop(loop.config, WORLDS)
    flight(theirs, range(3))
    assert bits(loop.snapshot()) == bits(theirs.snapshot())


def test_numpy_flies_where_it_is_asked_for_or_nothing_compiles(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = EnvConfig.from_keywords(HOVER, backend="rigid")
    plain = make_loop(replace(config, backend=replace(config.backend, compiled=False)))
    assert type(plain) is Loop
    imported = builtins.__import__

    def without(name: str, *args: Any, **options: Any) -> Any:
        if name.startswith("llvmlite"):
            raise ImportError("no llvmlite")
        return imported(name, *args, **options)

    monkeypatch.setattr(builtins, "__import__", without)
    llvm._llvm.cache_clear()
    try:
        loop = make_loop(config)
        assert type(loop) is Loop
        flight(make_loop(config, WORLDS), range(3))
        asked = replace(config, backend=replace(config.backend, compiled=True))
        with pytest.raises(InputError, match=r"compiled: expected false .*no llvmlite"):
            make_loop(asked)
    finally:
        monkeypatch.undo()
        llvm._llvm.cache_clear()
