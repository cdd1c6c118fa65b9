"""An `info` that is made when it is read: a dict for all who read it."""

import copy
import json
import pickle
from typing import Any

import numpy as np
import pytest
from contracts import HOVER
from rotorgram.envs.info import LazyInfo
from rotorgram.envs.vector import LocalVectorEnv

CONTENT = {"a": 1, "b": [2.5], "c": "three"}


class Made:
    """Gives the content, and counts how often."""

    count = 0

    def __call__(self) -> dict[str, Any]:
        self.count += 1
        return dict(CONTENT)


USES = [
    "{**info}",
    "dict(x=0, **info)",
    "dict(info)",
    "len(info)",
    "bool(info)",
    "repr(info)",
    "[*info]",
    "[*reversed(info)]",
    "[*info.keys()]",
    "[*info.values()]",
    "[*info.items()]",
    "json.dumps(dict(info))",
    "json.dumps(info)",
    "json.dumps([info], indent=1)",
    "LazyInfo(lambda: CONTENT) == info",
    "['a' in info, 'z' in info, 'z' not in info]",
    "info['b']",
    "[info.get('a'), info.get('z', 3)]",
    "[info == CONTENT, info != CONTENT, CONTENT == info, CONTENT != info, info == {}]",
    "info | {'a': 0, 'd': 4}",
    "{'a': 0, 'd': 4} | info",
    "info.copy()",
    "copy.copy(info)",
    "copy.deepcopy(info)",
    "pickle.loads(pickle.dumps(info))",
    "[plain := {'a': 0}, plain.update(info)]",
    "[info.__setitem__('a', 7), info]",
    "[info.__delitem__('a'), info]",
    "[info.pop('a'), info]",
    "[info.popitem(), info]",
    "[info.setdefault('a', 9), info.setdefault('z', 9), info]",
    "[info.update({'d': 5}), info]",
    "[info.clear(), info]",
    "[info.__ior__({'a': 0}), info]",
]


@pytest.mark.parametrize("text", USES)
def test_it_behaves_as_a_dict_and_is_made_once(text: str) -> None:
    made = Made()
    info = LazyInfo(made)
    assert isinstance(info, dict)
    assert made.count == 0
    names: dict[str, Any] = {"CONTENT": dict(CONTENT), "copy": copy, "json": json, "pickle": pickle}
    names["LazyInfo"] = LazyInfo
    expected = eval(text, names | {"info": dict(CONTENT)})
    found = eval(text, names | {"info": info})
    assert repr(found) == repr(expected)
    assert made.count == 1


def test_copies_do_not_share_their_content() -> None:
    info = LazyInfo(Made())
    deep = copy.deepcopy(info)
    deep["b"].append(0)
    shallow = copy.copy(info)
    shallow["a"] = 0
    assert info == CONTENT


def test_an_error_while_it_is_made_reaches_the_reader() -> None:
    def fail() -> dict[str, Any]:
        raise ValueError("no telemetry")

    info = LazyInfo(fail)
    for _ in range(2):
        with pytest.raises(ValueError, match="no telemetry"):
            len(info)


@pytest.mark.parametrize("compiled", [False, None])
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_what_an_env_puts_into_it_does_not_change_when_it_steps_on(
    mode: str, compiled: bool | None, caplog: pytest.LogCaptureFixture
) -> None:
    """An info that is read at once, and one that is read after all steps."""
    backend = {"name": "rigid", "compiled": compiled}
    infos = []
    for is_read in (True, False):
        env = LocalVectorEnv(HOVER, 5, autoreset_mode=mode, backend=backend, episode_length=4)
        infos.append([env.reset(seed=1)[1]])
        for number in range(6):
            actions = np.full(env.action_space.shape, 0.1 * number, np.float32)
            info = env.step(actions)[-1]
            if is_read:
                dict(info)
            infos[-1].append(info)
    assert not caplog.records  # it was compiled
    early, late = infos
    assert any(not np.array_equal(early[1]["z"], one["z"]) for one in early[2:])
    for first, second in zip(early, late, strict=True):
        assert list(first) == list(second)
        for name, values in first.items():
            if not name.startswith("final"):
                assert values.tobytes() == second[name].tobytes()
    assert ("final_info" in {*early[4]}) == (mode == "SameStep")
