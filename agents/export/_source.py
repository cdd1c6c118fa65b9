"""What C and C# share: the arithmetic, and text and numbers of a spec as source.

A spec comes from a file or a peer, so that none of its texts may be trusted.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Final, NamedTuple

import numpy as np

from ...envs.spec import ArraySpec, Discrete, EnvSpec, component_names
from ..policies import NetworkPolicy

_LARGEST: Final = float(np.finfo(np.float32).max)
_PAIRS: Final = re.compile(r"(?<=\*)(?=/)|(?<=/)(?=\*)|(?<=\?)(?=\?)")


def comment(text: str) -> str:
    """The text on one line of a comment: it neither ends nor begins one, and joins no lines.

    A character that cannot be printed and a backslash become `_`. `*/`, `/*`, and `??`, which
    begins a trigraph, get a space in between.
    """
    shown = "".join(c if c.isprintable() and c != "\\" else "_" for c in text)
    return _PAIRS.sub(" ", shown)


def number(value: float) -> str:
    """A float32 as a literal of C and C#: nine digits give back every bit."""
    digits = f"{value:.9g}"
    return digits + ("f" if re.search("[.e]", digits) else ".0f")


def table(values: np.ndarray, indent: str) -> str:
    """Numbers as lines of an initializer, six in a line.

    Infinite ones are the largest float32: C has no infinity without a library.
    """
    finite = values.clip(-_LARGEST, _LARGEST)
    words = [number(value) for value in finite.ravel().tolist()]
    lines = (", ".join(words[i : i + 6]) for i in range(0, len(words), 6))
    return ",\n".join(indent + line for line in lines)


class Element(NamedTuple):
    """An element of an array of a spec."""

    name: str
    unit: str
    frame: str
    low: float
    high: float


def elements(*arrays: ArraySpec) -> Iterator[Element]:
    """Every element of some arrays, one after the other, as a policy takes them."""
    for array in arrays:
        units = (array.unit,) * array.size if isinstance(array.unit, str) else array.unit
        low, high = (bound.ravel().tolist() for bound in array.bounds())
        for name, unit, *bounds in zip(component_names(array), units, low, high, strict=True):
            yield Element(name, unit, array.frame, *bounds)


def lists(spec: EnvSpec) -> dict[str, list[str]]:
    """Names and units of all elements, by the name that they have in the file."""
    observed, action = list(elements(*spec.observation)), spec.action
    listed = {
        "observation_names": [one.name for one in observed],
        "observation_units": [one.unit for one in observed],
        "observation_frames": [one.frame for one in observed],
    }
    if isinstance(action, Discrete):
        return listed | {"choice_names": _choices(action)}
    acted = list(elements(action))
    return listed | {
        "action_names": [one.name for one in acted],
        "action_units": [one.unit for one in acted],
    }


def _choices(action: Discrete) -> list[str]:
    return list(action.components) or [str(i) for i in range(action.n)]


def about(spec: EnvSpec, told: Mapping[str, str], target: str) -> list[str]:
    """Lines of a comment: what the policy is, and what each number means."""
    action = spec.action
    lines = [
        f"A policy of rotorgram, written by `rotorgram export --to {target}`.",
        "",
        f"env: {spec.env_id}, one action every {spec.control_period:g} s",
        f"options: {told['options']}",
        f"vehicle: {spec.vehicle} ({spec.vehicle_hash})",
        f"trained: {told['algorithm']}, seed {told['seed']}, {told['env_steps']} env steps",
        "observation:",
        *_described(elements(*spec.observation)),
    ]
    if isinstance(action, Discrete):
        lines.append("action, the number of a choice:")
        lines += [f"  {i}: {name}" for i, name in enumerate(_choices(action))]
    else:
        lines += ["action:", *_described(elements(action))]
    return [comment(line).rstrip() for line in lines]


def _described(listed: Iterable[Element]) -> Iterator[str]:
    for i, one in enumerate(listed):
        unit = "" if one.unit == "1" else one.unit
        words = [f"{one.low:g} to {one.high:g} {unit}".rstrip(), one.frame]
        yield f"  {i}: {one.name}: " + ", ".join(word for word in words if word)


def tables(policy: NetworkPolicy) -> dict[str, np.ndarray]:
    """All numbers of a policy, by the name that they have in the file."""
    found: dict[str, np.ndarray] = {}
    if policy.mean is not None and policy.scale is not None:
        found |= {"mean": policy.mean, "scale": policy.scale}
    for i, (weight, bias) in enumerate(policy.layers):
        found |= {f"weight_{i}": weight, f"bias_{i}": bias}
    if not policy.actions.discrete:
        names = ("middle", "half", "low", "high")
        found |= {f"action_{name}": getattr(policy.actions, name) for name in names}
    return found


def uses_tanh(policy: NetworkPolicy) -> bool:
    """Whether the arithmetic has a tanh."""
    return policy.squash or (policy.activation == "tanh" and len(policy.layers) > 1)


def body(policy: NetworkPolicy, name: Callable[[str], str]) -> tuple[dict[str, int], list[str]]:
    """Lengths of the buffers that are needed, and statements, the same in C and C#.

    `name` gives the identifier of a table or function. Of the functions, `layer` takes weight,
    bias, input and its length, output and its length, and `tanh` one number.
    """
    buffers: dict[str, int] = {}
    lines: list[str] = []
    at, actions = "observation", policy.actions

    def buffer(length: int) -> str:
        free = "b" if at == "a" else "a"
        buffers[free] = max(length, buffers.get(free, 0))
        return free

    def each(length: int, *statements: str) -> None:
        start = f"for (int i = 0; i < {length}; i++)"
        inner = [f"    {one}" for one in statements]
        lines.extend([start, *inner] if len(inner) == 1 else [f"{start} {{", *inner, "}"])

    if policy.mean is not None:
        length = policy.layers[0][0].shape[1]
        out = buffer(length)
        each(length, f"{out}[i] = ({at}[i] - {name('mean')}[i]) * {name('scale')}[i];")
        at = out
    for i, (weight, _) in enumerate(policy.layers):
        units, inputs = weight.shape
        if i:
            relu, tanh = f"{at}[i] < 0.0f ? 0.0f : {at}[i]", f"{name('tanh')}({at}[i])"
            each(inputs, f"{at}[i] = {tanh if policy.activation == 'tanh' else relu};")
        last = i == len(policy.layers) - 1 and not actions.discrete
        out = "action" if last else buffer(units)
        numbers = f"{name(f'weight_{i}')}, {name(f'bias_{i}')}"
        lines.append(f"{name('layer')}({numbers}, {at}, {inputs}, {out}, {units});")
        at = out
    if actions.discrete:
        lines.append("action[0] = 0.0f;")
        each(actions.outputs, f"action[0] = {at}[i] > {at}[(int)action[0]] ? (float)i : action[0];")
        return buffers, lines
    output = f"{name('tanh')}(action[i])" if policy.squash else "action[i]"
    low, high = f"{name('action_low')}[i]", f"{name('action_high')}[i]"
    each(
        actions.outputs,
        f"float y = {name('action_middle')}[i] + {name('action_half')}[i] * {output};",
        f"y = y < {low} ? {low} : y;",
        f"action[i] = y > {high} ? {high} : y;",
    )
    return buffers, lines
