"""C#: one class for .NET, Mono and Unity, of C# 7, without a package."""

import json
from collections.abc import Iterator, Mapping
from typing import Final
from xml.sax.saxutils import escape

from ...envs.spec import Discrete
from ..policies import NetworkPolicy
from ._source import about, body, lists, table, tables, uses_tanh

_LAYER: Final = """\
        static void Layer(float[] weight, float[] bias, float[] input, int inputs, float[] output,
                          int outputs)
        {
            for (int i = 0; i < outputs; i++) {
                float sum = 0.0f;
                for (int j = 0; j < inputs; j++)
                    sum += weight[i * inputs + j] * input[j];
                output[i] = sum + bias[i];
            }
        }
"""
_TANH: Final = """
        static float Tanh(float x) { return (float)Math.Tanh(x); }
"""
_ACT: Final = """\
        /// <summary>Writes the action for an observation. Allocates nothing.</summary>
        public void Act(float[] observation, float[] action)
        {
            if (observation.Length != Observations || action.Length != Actions)
                throw new ArgumentException("expected Observations and Actions numbers");"""


def write(policy: NetworkPolicy, told: Mapping[str, str]) -> bytes:
    """A class `Rotorgram.RotorgramPolicy` with `void Act(float[] observation, float[] action)`.

    A discrete action is the number of the choice, in one element.
    """
    buffers, lines = body(policy, _name)
    parts = [
        "using System;\n",
        "namespace Rotorgram",
        "{",
        "    /// <summary>",
        *(f"    /// {escape(line)}".rstrip() for line in about(policy.spec, told, "csharp")),
        "    /// </summary>",
        "    public sealed class RotorgramPolicy",
        "    {",
        *_constants(policy, told),
        "",
    ]
    for name, values in tables(policy).items():
        numbers = table(values, " " * 12)
        access = "public " if name in ("action_low", "action_high") else ""
        start = f"        {access}static readonly float[] {_name(name)} = {{"
        parts.append(f"{start}\n{numbers}\n        }};")
    parts += [f"        readonly float[] {n} = new float[{m}];" for n, m in sorted(buffers.items())]
    parts += ["", _ACT, *(f"            {line}" for line in lines), "        }\n"]
    functions = _LAYER + (_TANH if uses_tanh(policy) else "")
    return "\n".join([*parts, f"{functions}    }}\n}}\n"]).encode()


def _constants(policy: NetworkPolicy, told: Mapping[str, str]) -> Iterator[str]:
    spec, action = policy.spec, policy.spec.action
    numbers = {
        "int Format": told["format"],
        "int Observations": told["inputs"],
        "int Actions": policy.actions.size,
        "double ControlPeriod": f"{spec.control_period!r}",
        "long Seed": told["seed"],
        "long EnvSteps": told["env_steps"],
    } | ({"int Choices": action.n} if isinstance(action, Discrete) else {})
    for name, number in numbers.items():
        yield f"        public const {name} = {number};"
    for name in ("algorithm", "env_id", "options", "vehicle", "vehicle_hash"):
        yield f"        public const string {_name(name)} = {_text(told[name])};"
    for name, texts in lists(spec).items():
        listed = ", ".join(map(_text, texts))
        yield f"        public static readonly string[] {_name(name)} = {{ {listed} }};"


def _name(name: str) -> str:
    """`weight_0` as C# writes names: `Weight0`."""
    return "".join(word.capitalize() for word in name.split("_"))


def _text(text: str) -> str:
    """A literal: C# has all escapes of JSON but that of the slash, which JSON writes as it is."""
    return json.dumps(text)
