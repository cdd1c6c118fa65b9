"""Exported policies, run by other programs, give the numbers of the policy."""

import json
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from drones import cases
from nets import policy_of as loaded
from nets import random_policy
from peers import ANY, Running
from rotorgram.agents import Checkpoint, load, store
from rotorgram.agents.episodes import Position
from rotorgram.agents.export import TARGETS, export, metadata
from rotorgram.agents.export import c as c_target
from rotorgram.agents.export import onnx as onnx_target
from rotorgram.agents.policies import NetworkPolicy, flat, flat_size
from rotorgram.cli import main
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.envs.spec import ArraySpec, Discrete, EnvSpec
from rotorgram.flights.trajectories import evaluation_seed
from rotorgram.models.errors import InputError
from rotorgram.udp import Simulator
from rotorgram.udp.journal.reader import Recording
from rotorgram.udp.protocol.messages import FLY, Command
from scripted import spec_of
from test_install import optional, run_without
from test_peers import PEERS, ROOT, compiled, ended, running, tool, waiting

ROWS = 10_000
C_FLAGS = ["-std=c99", "-O2", "-Wall", "-Wextra", "-pedantic", "-Werror"]
CPP_FLAGS = ["-x", "c++", "-std=c++11", *C_FLAGS[1:]]
# An access out of bounds, or what C leaves undefined, ends the program with a text on stderr.
CHECKED = ["-Wconversion", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]


def policy_of(
    spec: EnvSpec, hidden: tuple[int, ...] = (16,), activation: str = "relu", **kinds: Any
) -> NetworkPolicy:
    """A policy with random weights, whose outputs fill the range of actions."""
    policy = random_policy(spec, hidden, activation, 0.3, **kinds)
    rng = np.random.default_rng(5)
    for array in policy.weights.arrays.values():
        if array.ndim == 2:
            numbers = rng.normal(size=array.shape)
            array[...] = numbers / np.sqrt(array.shape[1])
    return policy


def plain_spec(actions: int) -> EnvSpec:
    """Of so many actions and one observation, without bounds."""
    action = ArraySpec(name="a", shape=(actions,))
    observation = ArraySpec(name="o", shape=(1,))
    return spec_of(action, [observation])


def elevation() -> EnvSpec:
    config = EnvConfig(env_id="rotorgram/Elevation-v0")
    return env_spec(config)


def hover(**keywords: str) -> EnvSpec:
    config = EnvConfig.from_keywords("rotorgram/Hover-v0", **keywords)
    return env_spec(config)


def sighted_config(**keywords: Any) -> EnvConfig:
    """Plain numbers, a depth camera, a lidar and single rays."""
    sensors = {
        "depth": {"rows": 5, "columns": 12},
        "lidar": {"model": "mid360", "rows": 3, "columns": 14},
        "tof": {"model": "multiranger"},
    }
    return EnvConfig.from_keywords("rotorgram/Forest-v0", sensors=sensors, **keywords)


def sighted() -> EnvSpec:
    return env_spec(sighted_config())


def pictured() -> EnvSpec:
    """Plain numbers, colours and a depth camera's picture."""
    views = "down@9x6,down_depth@9x6"
    return hover(cameras=views)


def told_of(spec: EnvSpec) -> dict[str, str]:
    position = Position(env_steps=4096, seconds=0.0)
    about = {"algorithm": "a2c", "config": {}, "seed": 7, "env_steps": 4096, "position": position}
    return metadata(Checkpoint(spec=spec, actor={}, state={}, **about))  # type: ignore[arg-type]


def observations_of(spec: EnvSpec, rows: int = ROWS) -> np.ndarray:
    """Half of them around 0 and up to the bounds, half up to a hundred times as far."""
    rng = np.random.default_rng(1)
    bounds = []
    for array in spec.observation:
        sizes = np.abs(np.stack(array.bounds()))
        bounds.append(sizes.max(0).ravel())
    far = np.minimum(np.concatenate(bounds), 10.0)
    drawn = far * rng.uniform(-1, 1, (rows, far.size))
    half = rows // 2
    exponents = rng.uniform(0, 2, (rows - half, 1))
    drawn[half:] *= 10.0**exponents
    return drawn.astype(np.float32)


def by_policy(policy: NetworkPolicy, observations: np.ndarray) -> np.ndarray:
    actions = [np.ravel(policy.act(row)) for row in observations]
    return np.array(actions, np.float64)


# Each runs the file of a target on observations, in a folder.


def by_onnxruntime(policy: NetworkPolicy, observations: np.ndarray, folder: Path) -> np.ndarray:
    content = onnx_target.write(policy, told_of(policy.spec))
    session = onnxruntime.InferenceSession(content)
    (action,) = session.run(["action"], {"observation": observations})
    return np.asarray(action).reshape(len(observations), -1)


C_MAIN = """
#include <stdio.h>
#include "rotorgram_policy.h"

int main(void)
{
    float observation[ROTORGRAM_OBSERVATIONS], action[ROTORGRAM_ACTIONS];
    while (fread(observation, sizeof observation, 1, stdin) == 1) {
        rotorgram_policy(observation, action);
        fwrite(action, sizeof action, 1, stdout);
    }
    return 0;
}
"""


def fed(observations: np.ndarray, *command: object) -> np.ndarray:
    words = [str(word) for word in command]
    done = subprocess.run(words, input=observations.tobytes(), capture_output=True, timeout=60)
    assert done.returncode == 0
    assert done.stderr == b""
    actions = np.frombuffer(done.stdout, np.float32)
    return actions.reshape(len(observations), -1)


def by_gcc(
    policy: NetworkPolicy, observations: np.ndarray, folder: Path, compiler: str = "gcc"
) -> np.ndarray:
    header = folder / "rotorgram_policy.h"
    main = folder / "main.c"
    program = folder / "main"
    header.write_bytes(c_target.write(policy, told_of(policy.spec)))
    main.write_text(C_MAIN)
    flags = [*C_FLAGS, *CHECKED] if compiler == "gcc" else CPP_FLAGS
    compiled(tool(compiler), *flags, "-o", program, main)
    return fed(observations, program)


def by_gpp(policy: NetworkPolicy, observations: np.ndarray, folder: Path) -> np.ndarray:
    return by_gcc(policy, observations, folder, "g++")


CHOICE = spec_of(Discrete(choices=5, components=("a", "b", "c", "d", "e")))
HALF = ArraySpec(name="a", shape=(3,), low=(0.0, -np.inf, -np.inf), high=(100.0, 0.5, np.inf))
HALF_BOUNDED = spec_of(HALF)
CASES: dict[str, Callable[[], NetworkPolicy]] = {
    "paper": lambda: policy_of(elevation()),
    "tanh": lambda: policy_of(hover(), (64, 64), "tanh"),
    "squashed": lambda: policy_of(hover(vehicle="crazyflie2"), (32, 32), squash=True),
    "hexa": lambda: policy_of(hover(vehicle="heavy_hexa")),
    "half bounded": lambda: policy_of(HALF_BOUNDED, (8,)),
    "choice": lambda: policy_of(CHOICE, (16, 8), "tanh"),
    "by sight": lambda: policy_of(env_spec(EnvConfig(env_id="rotorgram/Forest-v0")), (16,), "tanh"),
    "by convolutions": lambda: policy_of(sighted(), (16,), "tanh", network="cnn"),
    "by pictures": lambda: policy_of(pictured(), (16,), "tanh", network="cnn"),
    "of relu": lambda: policy_of(sighted(), (16,), network="cnn"),
    "linear": lambda: policy_of(spec_of(), ()),
    "softened": lambda: policy_of(hover(vehicle="crazyflie2"), (32,), "tanh", reach=2.5),
    "near": lambda: policy_of(hover(vehicle="crazyflie2"), (32,), "tanh", reach=0.25),
}
RUNNERS = {"onnxruntime": by_onnxruntime, "gcc": by_gcc, "g++": by_gpp}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("runner", RUNNERS)
def test_numbers_are_those_of_the_policy(case: str, runner: str, tmp_path: Path) -> None:
    policy = CASES[case]()
    observations = observations_of(policy.spec)
    expected = by_policy(policy, observations)
    actions = RUNNERS[runner](policy, observations, tmp_path)
    assert actions.shape == expected.shape
    # Far outside the bounds, an observation of 1000 is itself known to 6e-5 alone.
    largest = np.abs(observations).max(1, keepdims=True)
    far = np.maximum(1.0, largest / 10.0)
    error = np.abs(actions - expected)
    ratio = error / (far + np.abs(expected))
    assert ratio.max() <= 1e-5
    different = np.unique(expected, axis=0)
    least = 3 if case == "choice" else ROWS // 20
    assert len(different) > least


C_EPISODES = """
#include <stdio.h>
#include "rotorgram_policy.h"

int main(void)
{
    rotorgram_policy_state state;
    float row[1 + ROTORGRAM_OBSERVATIONS], action[ROTORGRAM_ACTIONS];
    while (fread(row, sizeof row, 1, stdin) == 1) {
        if (row[0] > 0)
            rotorgram_policy_init(&state);
        rotorgram_policy(&state, row + 1, action);
        fwrite(action, sizeof action, 1, stdout);
    }
    return 0;
}
"""


def flown_by_memory(network: str) -> tuple[NetworkPolicy, list[np.ndarray], list[np.ndarray]]:
    """Observations and actions of two whole episodes that a policy with a GRU flies."""
    config = sighted_config(backend="rigid", episode_length=150)
    policy = policy_of(env_spec(config), (16,), "tanh", network=network, memory=12)
    observations: list[np.ndarray] = []
    actions: list[np.ndarray] = []
    env = LocalVectorEnv(config, 1, autoreset_mode="Disabled")
    for seed in (1, 2):
        policy.reset()
        seen, _ = env.reset(seed=seed)
        rows = []
        done = False
        own = []
        while not done:
            rows.append(flat(seen, env.env_spec, 1)[0])
            own.append(np.ravel(policy.act(seen)).copy())
            seen, _, terminated, truncated, _ = env.step(own[-1][None])
            done = bool(terminated[0] or truncated[0])
        observations.append(np.array(rows))
        actions.append(np.array(own))
    env.close()
    return policy, observations, actions


def states_of_onnx(policy: NetworkPolicy, episodes: list[np.ndarray]) -> np.ndarray:
    """Actions of all episodes, with the state carried from call to call."""
    session = onnxruntime.InferenceSession(onnx_target.write(policy, told_of(policy.spec)))
    found = []
    for rows in episodes:
        state = np.zeros((1, 12), np.float32)
        for row in rows:
            feed = {"observation": row[None], "state": state}
            action, state = session.run(["action", "next_state"], feed)
            found.append(action[0])
    return np.array(found)


def states_of_c(
    policy: NetworkPolicy, episodes: list[np.ndarray], folder: Path, compiler: str
) -> np.ndarray:
    header = folder / "rotorgram_policy.h"
    header.write_bytes(c_target.write(policy, told_of(policy.spec)))
    (folder / "main.c").write_text(C_EPISODES)
    flags = [*C_FLAGS, *CHECKED] if compiler == "gcc" else CPP_FLAGS
    compiled(tool(compiler), *flags, "-o", folder / "main", folder / "main.c")
    begins = [np.arange(len(rows)) == 0 for rows in episodes]
    rows = np.column_stack((np.concatenate(begins), np.concatenate(episodes)))
    return fed(rows.astype(np.float32), folder / "main")


@pytest.mark.parametrize("network", ["mlp", "cnn"])
def test_a_memory_flies_whole_episodes_as_the_policy_does(network: str, tmp_path: Path) -> None:
    policy, observations, actions = flown_by_memory(network)
    expected = np.concatenate(actions)
    assert min(map(len, actions)) > 10
    assert np.abs(actions[0][:5] - actions[1][:5]).max() > 1e-3
    found = {
        "onnx": states_of_onnx(policy, observations),
        "gcc": states_of_c(policy, observations, tmp_path, "gcc"),
        "g++": states_of_c(policy, observations, tmp_path, "g++"),
    }
    for name, theirs in found.items():
        np.testing.assert_allclose(theirs, expected, rtol=0, atol=1e-5, err_msg=name)
    onnx.checker.check_model(onnx.load_from_string(onnx_target.write(policy, {})), full_check=True)


@pytest.mark.parametrize("runner", RUNNERS)
def test_tanh_is_exact_from_the_smallest_number_to_the_largest(runner: str, tmp_path: Path) -> None:
    near = np.linspace(-12, 12, 20_001)
    small = np.geomspace(1e-30, 10, 10_001)
    corners = [0.0, 9.1, -9.1, 1e30, -1e30, np.inf, -np.inf]
    numbers = np.concatenate([near, small, -small, corners])
    seen = numbers.astype(np.float32)[:, np.newaxis]
    spec = plain_spec(1)
    weight = np.array([[0.0, 1.0]], np.float32)
    policy = loaded({"layers.0.weight": weight}, spec, squash=True)
    actions = RUNNERS[runner](policy, seen, tmp_path)
    expected = np.tanh(seen.astype(np.float64))
    error = np.abs(actions - expected)
    assert (error <= 5e-7 * np.abs(expected)).all()
    assert np.abs(actions).max() == pytest.approx(1.0, abs=1.3e-7)


@pytest.mark.parametrize("runner", RUNNERS)
def test_weights_keep_every_bit(runner: str, tmp_path: Path) -> None:
    """Of the smallest number, of the largest, and of some that no short decimal gives."""
    numbers = [1e-45, 1.1754944e-38, 3.4028235e38, 1 / 3, -0.1, 16777217.0, 1e-5, 123456.79, 2.0]
    bias = np.array(numbers, np.float32)
    count = len(numbers)
    spec = plain_spec(count)
    weights = {
        "layers.0.weight": np.stack((bias, 0 * bias), axis=1),
        "log_std": np.zeros(count, np.float32),
    }
    policy = loaded(weights, spec)
    seen = np.ones((1, 1), np.float32)
    actions = RUNNERS[runner](policy, seen, tmp_path)
    assert actions.tolist() == [bias.tolist()]


def test_what_is_no_number_is_not_made_one(tmp_path: Path) -> None:
    for case in ("paper", "tanh", "squashed"):
        policy = CASES[case]()
        size = flat_size(policy.spec)
        seen = np.full((1, size), np.nan, np.float32)
        actions = by_gcc(policy, seen, tmp_path)
        assert np.isnan(actions).all()


def test_the_header_needs_nothing_but_a_compiler(tmp_path: Path) -> None:
    header = tmp_path / "rotorgram_policy.h"
    program = tmp_path / "policy.c"
    policy = policy_of(hover(), (64, 64), "tanh", squash=True)
    header.write_bytes(c_target.write(policy, told_of(policy.spec)))
    assert "#include" not in header.read_text()
    program.write_text(
        '#include "rotorgram_policy.h"\n#include "rotorgram_policy.h"\n'  # twice: it is guarded
        "void act(const float *o, float *a);\n"
        "void act(const float *o, float *a) { rotorgram_policy(o, a); }\n"
    )
    strict = ["-Wconversion", "-Wdouble-promotion", "-Wshadow", "-ffreestanding"]
    object_file = tmp_path / "policy.o"
    compiled(tool("gcc"), *C_FLAGS, *strict, "-c", "-o", object_file, program)
    compiled(tool("nm"), "-u", object_file)  # names that a library would have to give
    program.write_text('#include "rotorgram_policy.h"\nint main(void) { return 0; }\n')
    compiled(tool("gcc"), *C_FLAGS, "-o", tmp_path / "unused", program)


# From a checkpoint.


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a short training, whose 16 units are then those of a PD law that flies."""
    folder = tmp_path_factory.mktemp("trained") / "run"
    words = "train a2c --env-steps 512 --num-envs 8 --seed 3 --out"
    assert main([*words.split(), str(folder)]) == 0
    path = folder / "checkpoint.safetensors"
    kept = load(path)
    actor = {name: np.zeros_like(array) for name, array in kept.actor.items()}
    law = np.array([9.0, 6.0, -9.8])
    actor["layers.0.weight"][:2, 1:] = law, -law
    actor["layers.1.weight"][0, 1:3] = 1.0, -1.0
    store(replace(kept, actor=actor), path)
    return folder


def exported(source: Path, target: str, folder: Path) -> Path:
    """The file that the command writes, by its own name."""
    path = folder / TARGETS[target]
    assert main(["export", str(source), "--to", target, "--out", str(path)]) == 0
    return path


def test_every_file_tells_what_it_is(trained: Path, tmp_path: Path) -> None:
    kept = load(trained / "checkpoint.safetensors")
    files = {target: exported(trained, target, tmp_path) for target in TARGETS}
    model = onnx.load(files["onnx"])
    onnx.checker.check_model(model, full_check=True)
    told = {entry.key: entry.value for entry in model.metadata_props}
    (operators,) = model.opset_import
    assert operators.domain == ""
    assert operators.version == 13
    plain = {
        "format": "1",
        "algorithm": "a2c",
        "seed": "3",
        "inputs": "3",
        "control_period": "0.02",
        "env_id": "rotorgram/Elevation-v0",
        "vehicle": kept.spec.vehicle,
        "vehicle_hash": kept.spec.vehicle_hash,
        "env_steps": str(kept.position.env_steps),
    }
    assert plain.items() <= told.items()
    assert json.loads(told["options"]) == kept.spec.options
    (observation,) = json.loads(told["observation"])
    names = ["elevation error", "rate of the error", "thrust over hover"]
    assert observation["components"] == names
    assert observation["unit"] == ["m", "m/s", "1"]
    assert observation["frame"] == "world, up"
    action = json.loads(told["action"])
    assert action["components"] == ["collective"]
    assert action["low"] == -1.0
    assert action["high"] == 1.0
    header = files["c"].read_text()
    for line in (
        "env: rotorgram/Elevation-v0, one action every 0.02 s",
        f"options: {told['options']}",
        f"vehicle: {told['vehicle']} ({told['vehicle_hash']})",
        f"trained: a2c, seed 3, {told['env_steps']} env steps",
    ):
        assert f"\n * {line}\n" in header
    assert "\n *   1: rate of the error: -11.2679 to 11.2679 m/s, world, up\n" in header
    numbers = {"OBSERVATIONS": 3, "ACTIONS": 1, "TELEMETRY": 20, "CONTROL_PERIOD": 0.02}
    for name, number in numbers.items():
        assert f"\n#define ROTORGRAM_{name} {number}\n" in header


EVIL = json.loads((ROOT / "tests" / "data" / "evil_texts.json").read_text(encoding="utf-8"))
"""Legal in a spec: no control character, at most 200 characters."""
WICKED = "".join(EVIL)
OPTIONS = {"a\\": "*/\n#error\r\u0085\\\n??/\n", WICKED: [WICKED, "\0\x7f"]}


@pytest.fixture
def evil(trained: Path, tmp_path: Path) -> dict[str, Path]:
    """Files of each target, with such texts wherever a spec has one."""
    kept = load(trained / "checkpoint.safetensors")
    names = tuple(EVIL)
    units = names[::-1]
    seen = ArraySpec(name="*/", shape=(len(names),), unit=units, frame=WICKED, components=names)
    action = ArraySpec(name="??/", shape=(2,), unit="*/", components=("\\", "/*"))
    named = {"env_id": WICKED, "vehicle": WICKED[::-1], "options": OPTIONS}
    spec = replace(kept.spec, **named, observation=(seen,), action=action)
    crafted = replace(kept, spec=spec, actor=policy_of(spec).weights.arrays)
    files = {target: tmp_path / TARGETS[target] for target in TARGETS}
    for target, path in files.items():
        path.write_bytes(export(crafted, target))
    return files


def test_no_text_of_a_spec_becomes_code_of_c(evil: dict[str, Path]) -> None:
    compiled(tool("gcc"), *C_FLAGS, "-fsyntax-only", "-x", "c", evil["c"])
    # Every line is one that the exporter began, and the header's comment ends where it should.
    header = evil["c"].read_text()
    head, _, rest = header.partition("\n */\n#ifndef")
    begins = {line[:2] for line in head.split("\n")}
    assert begins == {"/*", " *"}
    assert head.count("*/") == 0
    assert "/*" not in head[2:]
    assert "??" not in header  # C of 1999 has trigraphs
    assert "injected" not in rest
    assert "#error" not in rest
    assert "\u202e" not in header  # it would show the text in another order than it has


def test_onnx_has_every_text_of_a_spec_as_it_is(evil: dict[str, Path]) -> None:
    model = onnx.load(evil["onnx"])
    told = {entry.key: entry.value for entry in model.metadata_props}
    (observation,) = json.loads(told["observation"])
    assert observation["components"] == EVIL


@pytest.mark.parametrize("case", cases("wrong_exports"), ids=str)
def test_wrong_input_is_one_sentence(
    case: Any, trained: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(trained) if word == "RUN" else word for word in case["words"]]
    assert main(["export", *words]) == 1
    error = capsys.readouterr().err
    assert case["sentence"] in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("target", TARGETS)
def test_a_policy_that_diverged_is_refused(target: str, trained: Path) -> None:
    """Its weights are finite numbers, its actions are not."""
    kept = load(trained / "checkpoint.safetensors")
    actor = {name: array.copy() for name, array in kept.actor.items()}
    actor["layers.0.weight"][0] = 3e38
    actor["layers.1.weight"][0] = -3e38
    with pytest.raises(
        InputError, match=r"^policy: expected weights of at most 1e\+06, got 3e\+38"
    ):
        export(replace(kept, actor=actor), target)
    actor["layers.0.weight"][0] = np.nan
    with pytest.raises(InputError, match="got nan: training diverged"):
        export(replace(kept, actor=actor), target)


def test_only_onnx_needs_onnx(trained: Path, tmp_path: Path) -> None:
    def run(target: str) -> tuple[int, str]:
        out = tmp_path / target
        done = run_without(optional("export"), "export", trained, "--to", target, "--out", out)
        return done.returncode, done.stderr

    assert run("c") == (0, "")
    status, error = run("onnx")
    assert status == 1
    assert error.count("\n") == 1
    assert "pip install 'rotorgram[export]'" in error
    assert not (tmp_path / "onnx").exists()


# The C peer flies the header over the wire.


def flown_by_c(header: Path, seed: int) -> np.ndarray:
    """Actions of an episode, shape (T, k), that a simulator got by text."""
    program = header.with_name("agent")
    flags = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    policy = ['-DPOLICY="rotorgram_policy.h"', f"-I{header.parent}"]
    compiled(tool("gcc"), *flags, *policy, "-o", program, PEERS / "agent.c", "-lm")
    actions: list[np.ndarray] = []

    def observe(message: object) -> None:
        if isinstance(message, Command) and message.orders[0] == FLY:
            actions.append(np.atleast_1d(message.actions[0]).astype(np.float64))

    with running([str(program)], 0, 1, seed) as agent:
        env_id = "rotorgram/Elevation-v0"
        simulator = Simulator(env_id, server=waiting(agent), bind=ANY, codec="text")
        simulator.observers.append(observe)
        flight = Running(simulator)
        status, out, err = ended(agent)
        assert err == ""
        assert status == 0
        assert f"episode 1: {len(actions)} steps" in out
        flight.join()
    return np.array(actions)


def remembering(trained: Path) -> None:
    """Give the checkpoint of a folder a GRU and random weights."""
    path = trained / "checkpoint.safetensors"
    kept = load(path)
    config = {**kept.config, "memory": 8}
    actor = policy_of(kept.spec, memory=8).weights.arrays
    store(replace(kept, config=config, actor=actor).policy_alone(), path)


@pytest.mark.parametrize("memory", [False, True], ids=["reflex", "memory"])
def test_the_c_peer_flies_what_evaluate_flies(memory: bool, trained: Path, tmp_path: Path) -> None:
    trained = Path(shutil.copytree(trained, tmp_path / "run"))
    if memory:
        remembering(trained)
    journal = tmp_path / "ours.mcap"
    assert main(["evaluate", str(trained), "--episodes", "2", "--record", str(journal)]) == 0
    sent = [item.message for item in Recording(journal) if isinstance(item.message, Command)]
    ours = np.array([m.actions[0] for m in sent if m.orders[0] == FLY], np.float64)
    header = exported(trained, "c", tmp_path)
    theirs = [flown_by_c(header, evaluation_seed(episode, "final")) for episode in range(2)]
    lengths = [len(flight) for flight in theirs]
    assert memory or lengths == [250, 250]
    assert sum(lengths) == len(ours)
    assert min(lengths) > 20
    assert np.ptp(ours) > 0.3
    np.testing.assert_allclose(np.concatenate(theirs), ours, rtol=0, atol=1e-5)


# The page.


PAGE = (ROOT / "docs" / "export.md").read_text(encoding="utf-8")


def block(language: str) -> str:
    (code,) = re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    return str(code)


def test_the_program_of_the_page_runs(trained: Path, tmp_path: Path) -> None:
    header = exported(trained, "c", tmp_path)
    (tmp_path / "page.c").write_text(block("c"))
    compiled(tool("gcc"), *C_FLAGS, f"-I{header.parent}", "-o", tmp_path / "c", tmp_path / "page.c")
    done = subprocess.run([str(tmp_path / "c")], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "action 0: 1\n")  # 9 * 0.5, clipped


def test_the_page_shows_what_the_benchmark_wrote() -> None:
    content = json.loads((ROOT / "docs" / "results" / "export.json").read_text())
    for name, one in content["policies"].items():
        times = one["microseconds"]
        sizes = one["bytes"]
        row = " | ".join(f"{times[target]:.3g}" for target in ("NumPy", *TARGETS))
        assert f"| {name}: µs a call | {row} |" in PAGE
        row = " | ".join(f"{sizes[target]:,}" for target in TARGETS)
        assert f"| bytes of the file | | {row} |" in PAGE
        assert f"| bytes, compiled | | | {sizes['c, compiled']:,} |" in PAGE
