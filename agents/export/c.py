"""C: one header of C99, and C++ too, without a library and without allocation.

A spec comes from a file or a peer, so that none of its texts may be trusted.
"""

import json
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
from ..convolutions import Convolution, Encoder
from ..layers import BRIGHTEST, Affine, Floats, Layer, Scaling
from ..memory import GRU
from ..policies import NetworkPolicy, flat_size
from . import write_layers

ROTORS = {
    "hover": "N",
    "least": "N",
    "largest": "N",
    "initial": "N: when an episode begins",
    "positions": "m: x forward, y left, z up of each rotor in turn",
    "turns": "1: anticlockwise seen from above, -1: clockwise",
    "lags": "s: time constants of the speed, rising and falling; 0: trained without lag",
}
"""What is told of the rotors, in the order of the vehicle's file, and its unit."""

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

_CONVOLUTION = """
/* Sums over windows, a column of numbers of inputs each: filter by filter, as a row of weights. */
static inline void rotorgram_convolution(const float *weight, const int *places, int rows,
                                         int windows, const float *in, float *out, int filters)
{
    for (int i = 0; i < filters; i++, weight += 1 + rows)
        for (int k = 0; k < windows; k++) {
            float sum = weight[0];
            for (int j = 0; j < rows; j++)
                sum += weight[1 + j] * in[places[j * windows + k]];
            *out++ = sum;
        }
}"""
_GRU = """
/* Gates from sums over inputs and state: update, reset, candidate. Moves the state. */
static inline void rotorgram_gru(const float *sums, const float *recalled, float *state, int units)
{
    for (int i = 0; i < units; i++) {
        float update = 0.5f + 0.5f * rotorgram_tanh(0.5f * (sums[i] + recalled[i]));
        int j = units + i, k = j + units;
        float reset = 0.5f + 0.5f * rotorgram_tanh(0.5f * (sums[j] + recalled[j]));
        float candidate = rotorgram_tanh(sums[k] + reset * recalled[k]);
        state[i] = candidate + update * (state[i] - candidate);
    }
}"""
_STATE = """
/* What the policy remembers of an episode; initialise it when one begins. */
typedef struct {
    float memory[ROTORGRAM_STATE];
} rotorgram_policy_state;

static inline void rotorgram_policy_init(rotorgram_policy_state *state)
{
    for (int i = 0; i < ROTORGRAM_STATE; i++)
        state->memory[i] = 0.0f;
}"""


def write(policy: NetworkPolicy, facts: Mapping[str, str]) -> bytes:
    """A header with `void rotorgram_policy(const float observation[n], float action[k])`.

    With a memory a pointer to `rotorgram_policy_state` is its first argument.

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
        f"#define ROTORGRAM_CONTROL_PERIOD {facts['control_period']}",
        *_rotor_macros(facts),
        *_goal_macro(policy.spec),
    ]
    arguments = f"const float observation[{facts['inputs']}], float action[{policy.actions.size}]"
    if policy.memory:
        parts.append(f"#define ROTORGRAM_STATE {policy.memory.units}\n{_STATE}")
        arguments = f"rotorgram_policy_state *state, {arguments}"
    parts.append("")
    for name, values in program.tables.items():
        numbers = _table(values)
        kind = "int" if values.dtype.kind == "i" else "float"
        parts.append(f"static const {kind} rotorgram_{name}[{values.size}] = {{\n{numbers}\n}};")
    parts += program.functions
    parts += [
        "\n/* The action for an observation. */",
        f"static inline void rotorgram_policy({arguments})",
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
        functions: Texts of those that the statements call.
    """

    def __init__(self, policy: NetworkPolicy) -> None:
        self.tables: dict[str, np.ndarray] = {}
        self.functions = [_LAYER]
        self.lines: list[str] = []
        self.at = "observation"
        self.size = flat_size(policy.spec)
        write_layers(self, policy.layers)
        if policy.actions.discrete:
            self.lines.append("action[0] = 0.0f;")
            largest = f"{self.at}[(int)action[0]]"
            self._each(f"action[0] = {self.at}[i] > {largest} ? (float)i : action[0];")
        else:
            self._act(policy)

    def affine(self, layer: Affine) -> None:
        self._sum(layer.weight, self.at)

    def relu(self, layer: Layer) -> None:
        self._each(f"{self.at}[i] = {self.at}[i] < 0.0f ? 0.0f : {self.at}[i];")

    def tanh(self, layer: Layer) -> None:
        self._needs(_TANH)
        self._each(f"{self.at}[i] = rotorgram_tanh({self.at}[i]);")

    def _sum(self, weight: Floats, inputs: str) -> str:
        """An affine layer over an array; the name of its outputs."""
        units, size = weight.shape
        outputs = self._array(units)
        table = self._table(weight)
        arguments = f"{table}, {inputs}, {size - 1}, {outputs}, {units}"
        self.lines.append(f"rotorgram_layer({arguments});")
        return outputs

    def convolution(self, layer: Convolution) -> None:
        self._needs(_CONVOLUTION)
        filters = len(layer.weight)
        rows, windows = layer.places[1:].shape
        tables = f"{self._table(layer.weight)}, {self._table(layer.places[1:] - 1)}"
        inputs = f"{rows}, {windows}, {self.at}"
        outputs = self._array(filters * windows)
        self.lines.append(f"rotorgram_convolution({tables}, {inputs}, {outputs}, {filters});")

    def encoder(self, layer: Encoder) -> None:
        """Each array by its own layers, joined."""
        inputs = self.at
        size = self.size
        joined = self._array(layer.outputs)
        for chain, taken, given in zip(layer.chains, layer.taken, layer.given, strict=True):
            self.at = inputs
            self.size = size
            first = 0 if chain.layers else taken.start
            write_layers(self, chain.layers)
            self.size = given.stop - given.start
            self._each(f"{joined}[{given.start} + i] = {self.at}[{first} + i];")
        self.at = joined
        self.size = layer.outputs

    def gru(self, layer: GRU) -> None:
        self._needs(_TANH)
        self._needs(_GRU)
        sums = self._sum(layer.weight, self.at)
        without_bias = np.zeros_like(layer.recurrent[:, :1])
        recurrent = np.concatenate((without_bias, layer.recurrent), axis=1)
        recalled = self._sum(recurrent, "state->memory")
        self.lines.append(f"rotorgram_gru({sums}, {recalled}, state->memory, {layer.units});")
        outputs = self._array(layer.units)
        self._each(f"{outputs}[i] = state->memory[i];")

    def _array(self, size: int) -> str:
        """The name of a new array of numbers, which is that of the numbers so far."""
        self.at = f"x{len(self.lines)}"
        self.size = size
        self.lines.append(f"float {self.at}[{size}];")
        return self.at

    def _needs(self, function: str) -> None:
        if function not in self.functions:
            self.functions.append(function)

    def _table(self, values: np.ndarray, name: str = "") -> str:
        """The name of a new table."""
        name = name or f"weight_{len(self.tables)}"
        self.tables[name] = values
        return f"rotorgram_{name}"

    def _each(self, statement: str, place: slice | None = None) -> None:
        """A loop over the numbers so far, or those of a place."""
        place = place or slice(0, self.size)
        loop = f"for (int i = {place.start}; i < {place.stop}; i++)"
        self.lines += [loop, f"    {statement}"]

    def scaling(self, layer: Scaling) -> None:
        """Distances, pictures and lengths as networks see them, in a copy of the observation."""
        seen = self._array(self.size)
        self._each(f"{seen}[i] = observation[i];")
        for place in layer.pictures:
            self._each(f"{seen}[i] /= {BRIGHTEST}f;", place)
        for place in layer.distances:
            self._each(f"{seen}[i] = {seen}[i] < 0.0f ? 0.0f : 0.5f * {seen}[i];", place)
            self._each(f"{seen}[i] = 2.0f / (1.0f + {seen}[i]) - 0.5f;", place)
        for place in layer.lengths:
            size = f"({seen}[i] < 0.0f ? -{seen}[i] : {seen}[i])"
            softer = f"(1.0f + {size} / {layer.reach}f)"
            self._each(f"{seen}[i] /= {layer.unit}f * {softer};", place)

    def _act(self, policy: NetworkPolicy) -> None:
        """Map the outputs to the range of the action, and clip them to its bounds."""
        actions = policy.actions
        names = ("middle", "half", "low", "high")
        tables = (self._table(getattr(actions, name), f"action_{name}") for name in names)
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


def _table(values: np.ndarray) -> str:
    """Numbers as lines of an initializer, six in a line.

    Infinite ones are the largest float32: C has no infinity without a library.
    """
    words = _words(values)
    lines = [", ".join(words[first : first + 6]) for first in range(0, len(words), 6)]
    return ",\n".join(f"    {line}" for line in lines)


def _words(values: np.ndarray) -> list[str]:
    """Numbers as literals."""
    if values.dtype.kind != "f":
        return [str(value) for value in values.ravel().tolist()]
    finite = values.clip(-_LARGEST, _LARGEST)
    return [_number(value) for value in finite.ravel().tolist()]


def macro(name: str, values: object, comment: str = "") -> str:
    """A macro whose value initialises an array."""
    numbers = ", ".join(_words(np.asarray(values)))
    return f"#define ROTORGRAM_{name.upper()} {{{numbers}}} /* {_comment(comment)} */"


def _rotor_macros(facts: Mapping[str, str]) -> Iterator[str]:
    """What the checkpoint knows of the rotors."""
    rotors = json.loads(facts.get("rotors", "{}"))
    if rotors:
        yield "\n/* Of the rotors, in the order of the vehicle's file. */"
        yield f"#define ROTORGRAM_ROTORS {len(rotors['hover'])}"
    for name, values in rotors.items():
        yield macro(name, values, ROTORS[name])


def _goal_macro(spec: EnvSpec) -> Iterator[str]:
    """Where the observation has what follows the goal."""
    names = [name for array in spec.observation for name in component_names(array)]
    goal = {i: name for i, name in enumerate(names) if name.startswith("goal")}
    if goal:
        yield macro("goal", [*goal], "elements of the observation: " + ", ".join(goal.values()))


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
