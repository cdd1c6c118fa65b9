"""C: one header of C99, and C++ too, without a library and without allocation.

A spec comes from a file or a peer, so that none of its texts may be trusted.
"""

import re
from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from ...envs.spec import (
    BODY_TO_WORLD,
    ArraySpec,
    Discrete,
    EnvSpec,
    component_names,
    component_units,
)
from ..networks import Affine, Floats, Nearness, Relu, Tanh
from ..policies import NetworkPolicy, flat_size

_LARGEST = float(np.finfo(np.float32).max)
_PAIRS = re.compile(r"(?<=\*)(?=/)|(?<=/)(?=\*)|(?<=\?)(?=\?)")
_LAYER = """
/* Each output has a row of weights: the bias, then one for each input. */
static inline void rotorgram_layer(const float *weight, const float *in, int inputs,
                                   float *out, int outputs)
{
    for (int i = 0; i < outputs; i++) {
        float sum = *weight++;
        for (int j = 0; j < inputs; j++)
            sum += *weight++ * in[j];
        out[i] = sum;
    }
}"""
_TANH = """
/* tanh to 5e-7: of x / 8 by Lambert's continued fraction, then three times
 * tanh 2y = 2 tanh y / (1 + tanh^2 y). Beyond 9.1 the nearest float is 1. */
static inline float rotorgram_tanh(float x)
{
    float y = (x > 9.1f ? 9.1f : x < -9.1f ? -9.1f : x) / 8.0f;
    float s = y * y;
    float t = y * (10395.0f + s * (1260.0f + s * 21.0f))
              / (10395.0f + s * (4725.0f + s * (210.0f + s)));
    for (int i = 0; i < 3; i++)
        t = 2.0f * t / (1.0f + t * t);
    return t;
}"""


def write(policy: NetworkPolicy, facts: Mapping[str, str]) -> bytes:
    """A header with `void rotorgram_policy(const float observation[n], float action[k])`.

    A discrete action is the number of the choice, in one element. An infinite bound is the largest
    float32: C has no infinity without a library.
    """
    program = _Program(policy)
    parts = [
        "/* " + "\n * ".join(_about(policy.spec, facts)).replace(" * \n", " *\n") + "\n */",
        "#ifndef ROTORGRAM_POLICY_H\n#define ROTORGRAM_POLICY_H\n",
        "/* Lengths of the arrays below; numbers of the telemetry by the text codec. */",
        f"#define ROTORGRAM_OBSERVATIONS {facts['inputs']}",
        f"#define ROTORGRAM_ACTIONS {policy.actions.size}",
        f"#define ROTORGRAM_TELEMETRY {sum(map(_text_size, policy.spec.telemetry))}",
        f"#define ROTORGRAM_CONTROL_PERIOD {facts['control_period']}\n",
    ]
    for name, values in program.tables.items():
        numbers = _table(values)
        parts.append(f"static const float rotorgram_{name}[{values.size}] = {{\n{numbers}\n}};")
    parts.append(_LAYER)
    if any(isinstance(layer, Tanh) for layer in policy.network.layers):
        parts.append(_TANH)
    parts += [
        "\n/* The action for an observation. */",
        f"static inline void rotorgram_policy(const float observation[{facts['inputs']}],",
        f"                                    float action[{policy.actions.size}])",
        "{",
        *(f"    {line}" for line in program.lines),
        "}\n",
        "#endif\n",
    ]
    return "\n".join(parts).encode()


class _Program:
    """Statements, and the tables that they use, of the layers of a policy.

    Attributes:
        at: Name of the array with the numbers so far, `size` of them.
    """

    def __init__(self, policy: NetworkPolicy) -> None:
        self.tables: dict[str, Floats] = {}
        self.lines: list[str] = []
        self.at = "observation"
        self.size = flat_size(policy.spec)
        for layer in policy.network.layers:
            if isinstance(layer, Affine):
                units = len(layer.weight)
                number = len(self.tables)
                weight = self._table(f"weight_{number}", layer.weight)
                outputs = f"x{number}"
                arguments = f"{weight}, {self.at}, {self.size}, {outputs}, {units}"
                self.lines += [f"float {outputs}[{units}];", f"rotorgram_layer({arguments});"]
                self.at = outputs
                self.size = units
            elif isinstance(layer, Nearness):
                self._near(layer)
            elif isinstance(layer, Relu):
                self._each(f"{self.at}[i] = {self.at}[i] < 0.0f ? 0.0f : {self.at}[i];")
            else:
                self._each(f"{self.at}[i] = rotorgram_tanh({self.at}[i]);")
        if policy.actions.discrete:
            self.lines.append("action[0] = 0.0f;")
            largest = f"{self.at}[(int)action[0]]"
            self._each(f"action[0] = {self.at}[i] > {largest} ? (float)i : action[0];")
        else:
            self._act(policy)

    def _table(self, name: str, values: Floats) -> str:
        self.tables[name] = values
        return f"rotorgram_{name}"

    def _each(self, statement: str) -> None:
        """A loop over the numbers so far."""
        self.lines += [f"for (int i = 0; i < {self.size}; i++)", f"    {statement}"]

    def _near(self, layer: Nearness) -> None:
        """Distances as nearness, in a copy of the observation."""
        self.lines.append(f"float seen[{self.size}];")
        self._each("seen[i] = observation[i];")
        self.at = "seen"
        for place in layer.places:
            self.lines += [
                f"for (int i = {place.start}; i < {place.stop}; i++)",
                "    seen[i] = 2.0f / (1.0f + (seen[i] < 0.0f ? 0.0f : 0.5f * seen[i])) - 0.5f;",
            ]

    def _act(self, policy: NetworkPolicy) -> None:
        """Map the outputs to the range of the action, and clip them to its bounds."""
        actions = policy.actions
        names = ("middle", "half", "low", "high")
        tables = (self._table(f"action_{name}", getattr(actions, name)) for name in names)
        middle, half, low, high = tables
        self.lines += [
            f"for (int i = 0; i < {self.size}; i++) {{",
            f"    float y = {middle}[i] + {half}[i] * {self.at}[i];",
            f"    y = y < {low}[i] ? {low}[i] : y;",
            f"    action[i] = y > {high}[i] ? {high}[i] : y;",
            "}",
        ]


def _comment(text: str) -> str:
    """The text on one line of a comment: it neither ends nor begins one, and joins no lines.

    A character that cannot be printed and a backslash become `_`. `*/`, `/*`, and `??`, which
    begins a trigraph, get a space in between.
    """
    shown = "".join(c if c.isprintable() and c != "\\" else "_" for c in text)
    return _PAIRS.sub(" ", shown)


def _number(value: float) -> str:
    """A float32 as a literal of C: nine digits give back every bit."""
    digits = f"{value:.9g}"
    return digits + ("f" if re.search("[.e]", digits) else ".0f")


def _table(values: Floats) -> str:
    """Numbers as lines of an initializer, six in a line.

    Infinite ones are the largest float32: C has no infinity without a library.
    """
    finite = values.clip(-_LARGEST, _LARGEST)
    words = [_number(value) for value in finite.ravel().tolist()]
    lines = [", ".join(words[first : first + 6]) for first in range(0, len(words), 6)]
    return ",\n".join(f"    {line}" for line in lines)


def _about(spec: EnvSpec, facts: Mapping[str, str]) -> list[str]:
    """Lines of a comment: what the policy is, and what each number means."""
    action = spec.action
    lines = [
        "A policy of rotorgram, written by `rotorgram export --to c`.",
        "",
        f"env: {spec.env_id}, one action every {spec.control_period:g} s",
        f"options: {facts['options']}",
        f"vehicle: {spec.vehicle} ({spec.vehicle_hash})",
        f"trained: {facts['algorithm']}, seed {facts['seed']}, {facts['env_steps']} env steps",
        "observation:",
        *_described(spec.observation, np.ones(1)),
    ]
    if isinstance(action, Discrete):
        lines.append("action, the number of a choice:")
        choices = action.components or range(action.choices)
        lines += [f"  {i}: {name}" for i, name in enumerate(choices)]
    else:
        lines += ["action:", *_described([action], spec.action_scale)]
    return [_comment(line).rstrip() for line in lines]


def _described(arrays: Iterable[ArraySpec], scale: np.ndarray) -> Iterator[str]:
    """A line for every element of some arrays, one after the other, as a policy takes them."""
    number = 0
    for array in arrays:
        low, high = (bound.ravel().tolist() for bound in array.bounds())
        scales = np.broadcast_to(scale, array.size).tolist()
        units = component_units(array)
        for place, name in enumerate(component_names(array)):
            scaled = "" if scales[place] == 1 else f"of {scales[place]:.7g} "
            bounds = f"{low[place]:g} to {high[place]:g} {scaled}{units[place]}".rstrip()
            frame = f", {array.frame}" if array.frame else ""
            yield f"  {number}: {name}: {bounds}{frame}"
            number += 1


def _text_size(array: ArraySpec) -> int:
    """Numbers of an array of telemetry by the text codec, which has three angles of a rotation."""
    return 3 if array.frame == BODY_TO_WORLD else array.size
