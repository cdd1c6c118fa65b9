"""`rotorgram check-task`: whether a task of one's own compiles, and keeps to what it declares."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from ..models.errors import InputError, one_line
from ..models.user_code import load_class, names_class
from ._flags import Command

if TYPE_CHECKING:
    import numpy as np

    from ..envs import Loop

WORLDS = 8
STEPS = 50
_ADVICE = (
    "take sin, exp, power, total … from rotorgram.sim in place of NumPy's and of **, "
    "and random numbers from `draw` alone"
)
Step = dict[str, "np.ndarray"]


class CheckTask(Command):
    """Check a task of your own before you train: does it compile, are its numbers right?

    Exit status 1 if something is wrong, with a sentence for each finding.
    """

    task: Positional[Annotated[str, arg(metavar="FILE.py:CLASS")]]
    """File and class of the task; or its id, or module:Name-v0."""

    def run(self) -> int:
        """Fly random actions by NumPy and compiled."""
        import logging

        logging.getLogger("rotorgram").setLevel(logging.ERROR)  # a finding says why
        env_id = _env_id(self.task)
        found = list(findings(env_id))
        for finding in found:
            print(f"{env_id}: {finding.removeprefix(f'{env_id}: ')}")
        if not found:
            flown = f"{WORLDS} worlds flew {STEPS} steps with the bits of NumPy"
            print(f"{env_id}: compiled; {flown}, within the bounds")
        return 1 if found else 0


def _env_id(task: str) -> str:
    """Id of a task, which is registered. Raises `InputError`."""
    from ..envs import Task, registry

    if not names_class(task):
        return registry.load(task)
    kind = load_class("task", task)
    name = kind.__name__
    if not issubclass(kind, Task):
        raise InputError(f"task: expected a class derived from Task, got {name!r}")
    registry.register(f"{name}-v0", kind)
    return f"{name}-v0"


def findings(env_id: str) -> Iterator[str]:
    """A sentence for each thing that is wrong with a task."""
    from dataclasses import replace

    from ..envs import EnvConfig, Loop, registry
    from ..envs.compiled import make_loop, place_of

    drones = registry.task_type(env_id).min_drones
    config = EnvConfig.from_keywords(env_id, drones=drones, backend="rigid")
    plain = replace(config, backend=replace(config.backend, compiled=False))
    try:
        loop = Loop(plain, WORLDS)
        first = _flight(loop)
        second = _flight(Loop(plain, WORLDS))
    except InputError as error:
        yield str(error)
        return
    except Exception as error:  # of the user's code, any
        yield f"{type(error).__name__}: {one_line(error)} ({place_of(error)})"
        return
    yield from _out_of_bounds(loop, first)
    drawn = _difference(first, second)
    if drawn:
        yield f"two flights of one seed differ in {drawn}: {_ADVICE}"
    compiled = make_loop(config, WORLDS)
    third = _flight(compiled)
    rounded = _difference(first, third)
    refusal = getattr(compiled, "refusal", "llvmlite does not work here")
    if refusal:
        yield f"not compiled, NumPy flies it: {refusal}"
    elif rounded and not drawn:
        yield f"compiled code and NumPy differ in {rounded}: {_ADVICE}"


def _flight(loop: "Loop") -> list[Step]:
    """What random actions give."""
    import numpy as np

    dice = np.random.default_rng(0)
    drones = loop.num_envs
    controller = loop.task.controller
    resets = np.ones(drones, bool)
    steps: list[Step] = []
    for step in range(STEPS):
        sent = dice.uniform(controller.low, controller.high, (drones, len(controller.low)))
        if controller.choices:
            sent = dice.integers(0, controller.choices, sent.shape).astype(np.float64)
        loop.advance(sent.astype(np.float32), resets, np.arange(drones) + step * drones)
        resets = loop.done
        steps.append({"reward": loop.rewards, "end": loop.terminated, **loop.observations})
    return steps


def _out_of_bounds(loop: "Loop", steps: list[Step]) -> Iterator[str]:
    for array in loop.spec.observation:
        low, high = array.bounds()
        for step in steps:
            values = step[array.name]
            wrong = (values < low.astype(values.dtype)) | (values > high.astype(values.dtype))
            if wrong.any():
                got = f"{values[wrong][0]:g} in component {wrong.nonzero()[-1][0]}"
                yield f"{array.name}: expected numbers within the bounds of its spec, got {got}"
                break


def _difference(ours: list[Step], theirs: list[Step]) -> str:
    """Where two flights differ first; empty: nowhere."""
    for number, (one, other) in enumerate(zip(ours, theirs, strict=True)):
        for name, values in one.items():
            if values.tobytes() != other[name].tobytes():
                most = abs(1.0 * values - other[name]).max()
                return f"{name} of step {number}, by up to {most:.1g}"
    return ""
