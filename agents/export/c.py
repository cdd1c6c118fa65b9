"""C: one header of C99, and C++ too, without a library and without allocation."""

from collections.abc import Iterator, Mapping
from typing import Final

from ...envs.spec import Discrete
from ..policies import NetworkPolicy
from ._source import about, body, lists, table, tables, uses_tanh

_LAYER: Final = """
/* out = weight . in + bias */
static inline void rotorgram_layer(const float *weight, const float *bias, const float *in,
                                   int inputs, float *out, int outputs)
{
    for (int i = 0; i < outputs; i++) {
        float sum = 0.0f;
        for (int j = 0; j < inputs; j++)
            sum += weight[i * inputs + j] * in[j];
        out[i] = sum + bias[i];
    }
}"""
_TANH: Final = """
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


def write(policy: NetworkPolicy, told: Mapping[str, str]) -> bytes:
    """A header with `void rotorgram_policy(const float observation[n], float action[k])`.

    A discrete action is the number of the choice, in one element. An infinite bound is the largest
    float32: C has no infinity without a library.
    """
    buffers, lines = body(policy, lambda name: f"rotorgram_{name}")
    inputs = policy.layers[0][0].shape[1]
    parts = [
        "/* " + "\n * ".join(about(policy.spec, told, "c")).replace(" * \n", " *\n") + "\n */",
        "#ifndef ROTORGRAM_POLICY_H\n#define ROTORGRAM_POLICY_H\n",
        *_constants(policy, told),
        "",
    ]
    for name, values in tables(policy).items():
        numbers = table(values, "    ")
        parts.append(f"static const float rotorgram_{name}[{values.size}] = {{\n{numbers}\n}};")
    parts += [_LAYER, _TANH] if uses_tanh(policy) else [_LAYER]
    parts += [
        "\n/* The action for an observation. */",
        f"static inline void rotorgram_policy(const float observation[{inputs}],",
        f"                                    float action[{policy.actions.size}])",
        "{",
        *(f"    float {name}[{length}];" for name, length in sorted(buffers.items())),
        *(f"    {line}" for line in lines),
        "}\n",
        "#endif\n",
    ]
    return "\n".join(parts).encode()


def _constants(policy: NetworkPolicy, told: Mapping[str, str]) -> Iterator[str]:
    """Macros: they take no memory where they are not used."""
    spec, action = policy.spec, policy.spec.action
    numbers = {
        "format": told["format"],
        "observations": told["inputs"],
        "actions": policy.actions.size,
        "telemetry": sum(array.size for array in spec.telemetry),
        "control_period": f"{spec.control_period!r}",
        "seed": told["seed"],
        "env_steps": told["env_steps"],
    } | ({"choices": action.n} if isinstance(action, Discrete) else {})
    for name, number in numbers.items():
        yield f"#define ROTORGRAM_{name.upper()} {number}"
    for name in ("algorithm", "env_id", "options", "vehicle", "vehicle_hash"):
        yield f"#define ROTORGRAM_{name.upper()} {_text(told[name])}"
    for name, texts in lists(spec).items():
        yield f"#define ROTORGRAM_{name.upper()} {{ {', '.join(map(_text, texts))} }}"


def _text(text: str) -> str:
    """A literal, in UTF-8. `?` is escaped because of trigraphs; octal escapes have three digits."""
    plain = {c: chr(c) for c in range(32, 127)} | {c: f"\\{chr(c)}" for c in b'"\\?'}
    return '"' + "".join(plain.get(c, f"\\{c:03o}") for c in text.encode()) + '"'
