"""Data sets of journals: what is in them, what is left out, and that they fly again bit for bit."""

import json
import resource
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pyarrow.parquet as pq
import pytest
from cases import each
from dataset import RecordedEpisodes, env_of, write_minari, write_parquet
from peers import ANY, Running
from programs import EXAMPLES
from relay import FaultConfig, relaying
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.envs.spec import EnvSpec
from rotorgram.models.errors import InputError
from rotorgram.udp import LinkConfig, RemoteEnv, RemoteVectorEnv, Simulator

LOSSY = FaultConfig(drop=0.1, duplicate=0.1, reorder=0.1, seed=3)
ELEVATION = "rotorgram/Elevation-v0"
HOVER = "rotorgram/Hover-v0"


@contextmanager
def recording(
    path: Path, env_id: str = ELEVATION, drones: int = 1, faults: FaultConfig | None = None,
    patience: float = 5, **options: Any,
) -> Iterator[Any]:  # fmt: skip
    """An agent's env over the wire; the agent keeps the journal. `patience`: s, to connect."""
    settings: dict[str, Any] = {"timeout": 5, "connect_timeout": patience, "connect": False}
    settings["record"] = path
    remote: Any
    if drones == 1:
        remote = RemoteEnv(ANY, **settings)
    else:
        remote = RemoteVectorEnv(ANY, num_envs=drones, **settings)
    with relaying(remote.address, faults or FaultConfig()) as relay:
        simulator = Simulator(
            env_id, server=relay.address, bind=ANY, num_envs=drones, config=LinkConfig(timeout=5),
            **options,
        )  # fmt: skip
        running = Running(simulator)
        try:
            yield remote
        finally:
            remote.close()
            running.join()


def fly_one(remote: RemoteEnv, seeds: list[int | None], most: int = 10**6) -> None:
    """Episodes of one drone, at random, of at most so many steps."""
    remote.reset(seed=0)
    remote.action_space.seed(1)
    for seed in seeds:
        remote.reset(seed=seed)
        for _ in range(most):
            _, _, terminated, truncated, _ = remote.step(remote.action_space.sample())
            if terminated or truncated:
                break


def fly_fleet(remote: RemoteVectorEnv, steps: int) -> None:
    """Drones at random; each reset has a seed of its own."""
    remote.reset(seed=11)
    remote.action_space.seed(1)
    for step in range(steps):
        seeds = [1000 * step + drone for drone in range(remote.num_envs)]
        frozen = np.arange(remote.num_envs) == step % 7  # now and then one of them waits
        remote.advance(remote.action_space.sample(), remote.done & ~frozen, seeds, frozen)


def same(a: Any, b: Any) -> bool:
    return bool(np.asarray(a).tobytes() == np.asarray(b).tobytes())


def assert_flies_again(
    env: gym.Env[Any, Any], seed: int, actions: Any, observations: dict[str, Any], *told: Any
) -> None:
    """These actions from this seed give the same bits; `told` are rewards and both flags."""
    observation, _ = env.reset(seed=seed)
    flown = [observation]
    outcomes = []
    for action in actions:
        observation, *outcome, _ = env.step(action)
        flown.append(observation)
        outcomes.append(outcome)
    for name, recorded in observations.items():
        again = [one[name] if isinstance(one, dict) else one for one in flown]
        assert same(np.stack(again), recorded)
    rewards, terminated, truncated = zip(*outcomes, strict=True)
    assert same(rewards, told[0])
    assert list(terminated) == told[1].tolist()
    assert list(truncated) == told[2].tolist()


@pytest.mark.parametrize("env_id", [ELEVATION, HOVER])
@pytest.mark.parametrize("drones", [1, 3])
def test_what_is_read_flies_again_to_the_same_bits(
    env_id: str, drones: int, tmp_path: Path
) -> None:
    path = tmp_path / "flight.mcap"
    with recording(path, env_id, drones, LOSSY, episode_length=30) as remote:
        if drones == 1:
            fly_one(remote, [5, 6, 2**64 - 1])
        else:
            fly_fleet(remote, 120)
    episodes = RecordedEpisodes([path])
    table = tmp_path / "flight.parquet"
    write_parquet(episodes, table)
    count = episodes.count
    steps = episodes.steps
    read = pq.read_table(table)
    frame = {name: read[name].to_numpy() for name in read.column_names if name != "journal"}
    assert read.num_rows == steps + count
    assert count == 3 or (drones == 3 and count > 3)
    with gym.make(env_of(episodes.spec), disable_env_checker=True) as env:
        for episode in range(count):
            rows = frame["episode"] == episode
            own = {name: values[rows] for name, values in frame.items()}
            seen = [values for name, values in own.items() if name.startswith("observation")]
            acted = [values for name, values in own.items() if name.startswith("action")]
            recorded = np.stack(seen, axis=1)
            actions = np.stack(acted, axis=1)[:-1]
            seed = int(read["seed"].filter(rows)[0].as_py())
            rewards = own["reward"][:-1].astype(np.float64)
            ends = own["terminated"][:-1], own["truncated"][:-1]
            assert recorded.dtype == np.float32
            assert own["step"].tolist() == list(range(len(recorded)))
            assert_flies_again(env, seed, actions, {"": recorded}, rewards, *ends)


@pytest.fixture
def minari(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "sets"))
    return pytest.importorskip("minari")


@pytest.mark.parametrize(
    "options",
    [
        {"action_type": "continuous"},
        {"action_type": "discrete"},
        {"sensors": {"barometer": {"noise": 0.1}}},
    ],
)
def test_minari_reads_it_and_its_env_flies_it_again(
    minari: Any, tmp_path: Path, options: dict[str, Any]
) -> None:
    path = tmp_path / "flight.mcap"
    with recording(path, faults=LOSSY, **options) as remote:
        fly_one(remote, [5, 2**64 - 1, None])
        spaces = remote.observation_space, remote.action_space
    episodes = RecordedEpisodes([path])
    write_minari(episodes, "rotorgram/flight-v0")
    assert episodes.count == 3
    data = minari.load_dataset("rotorgram/flight-v0")
    assert (data.observation_space, data.action_space) == spaces
    assert data.total_episodes == 3
    seeds = [one.get("seed") for one in data.storage.get_episode_metadata(range(3))]
    assert seeds == [5, 2**64 - 1, None]
    assert json.loads(data.storage.metadata["rotorgram_env_spec"])["env_id"] == ELEVATION
    with data.recover_environment(disable_env_checker=True) as env:
        assert (env.observation_space, env.action_space) == spaces
        for seed, episode in zip(seeds[:2], data, strict=False):
            seen = episode.observations
            recorded = seen if isinstance(seen, dict) else {"": seen}
            told = episode.rewards, episode.terminations, episode.truncations
            assert_flies_again(env, seed, episode.actions, recorded, *told)
            assert len(episode.infos["z"]) == len(episode.actions) + 1
            assert episode.infos["elevation_error"].dtype == np.float64


def test_ranges_are_lists_in_parquet(tmp_path: Path) -> None:
    """Those that the agent got; the flight gives them again."""
    path = tmp_path / "flight.mcap"
    sensors = {"depth": {"rows": 4, "columns": 6}, "tof": {"model": "multiranger"}}
    options: dict[str, Any] = {"scene": "forest:3", "episode_length": 20}
    got = []
    with recording(path, HOVER, patience=60, sensors=sensors, **options) as remote:
        got.append(remote.reset(seed=5)[0])
        remote.action_space.seed(1)
        ended = False
        while not ended:
            observation, _, terminated, truncated, _ = remote.step(remote.action_space.sample())
            got.append(observation)
            ended = terminated or truncated
    assert len(got) > 5
    table = tmp_path / "flight.parquet"
    episodes = RecordedEpisodes([path])
    write_parquet(episodes, table)
    read = pq.read_table(table)
    recorded = {}
    for name, shape in {"depth": (4, 6), "tof": (1, 5)}.items():
        rows = np.array(read[f"observation.{name}"].to_pylist(), np.float32)
        recorded[name] = rows.reshape(-1, *shape)
        assert same(recorded[name], np.stack([one[name] for one in got]))
    assert len(np.unique(recorded["depth"])) > 24
    names = [name for name in read.column_names if name.startswith("action")]
    actions = np.stack([read[name].to_numpy() for name in names], axis=1)[:-1]
    told = [read[name].to_numpy()[:-1] for name in ("reward", "terminated", "truncated")]
    told[0] = told[0].astype(np.float64)
    with gym.make(env_of(episodes.spec), disable_env_checker=True) as env:
        assert_flies_again(env, 5, actions.astype(np.float32), recorded, *told)


def test_flights_on_rigid_have_an_env_too() -> None:
    flown = env_spec(EnvConfig(backend="rigid"))
    assert flown.config_digest != env_spec(EnvConfig()).config_digest
    assert env_of(flown).id == flown.env_id


def test_episodes_that_are_not_whole_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    with recording(path, episode_length=5, start_band=0.0) as remote:
        remote.reset(seed=0)
        for seed, steps in (8, 5), (9, 3), (None, 5), (10, 2):
            remote.reset(seed=seed)
            for _ in range(steps):
                remote.step([0.25])
    episodes = RecordedEpisodes([path])
    found = list(episodes)
    # The reset with seed 0 has no step; those of 3 and 2 steps were given up.
    assert [(one.seed, len(one)) for one in found] == [(8, 5), (None, 5)]
    assert episodes.left_out == 2
    assert [one.ending for one in found] == ["truncated"] * 2
    assert found[0].actions.tolist() == [[0.25]] * 5
    assert found[0].observations["observation"].shape == (6, 3)
    assert found[0].telemetry["position"].shape == (6, 3)


def test_a_frozen_drone_makes_no_steps(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    with recording(path, drones=2, episode_length=4) as remote:
        remote.reset(seed=20)
        for step in range(6):  # drone 1 waits in steps 1 and 2, drone 0 after its end
            frozen = np.array([step >= 4, step in (1, 2)])
            remote.advance(np.full((2, 1), step / 8, np.float32), None, None, frozen)
    first, second = RecordedEpisodes([path])
    assert first.drone == 0
    assert first.seed == 20
    assert first.actions.ravel().tolist() == [0.0, 0.125, 0.25, 0.375]
    assert second.drone == 1
    assert second.seed == 21
    assert second.actions.ravel().tolist() == [0.0, 0.375, 0.5, 0.625]


def run(*words: object) -> subprocess.CompletedProcess[str]:
    """The example program."""
    command = [sys.executable, EXAMPLES / "dataset.py", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=110)


def test_several_journals_are_one_data_set(tmp_path: Path) -> None:
    paths = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    for seed, path in enumerate(paths):
        with recording(path, episode_length=4) as remote:
            fly_one(remote, [seed])
    out = tmp_path / "both.parquet"
    done = run(*paths, "--to", "parquet", "--out", out)
    assert done.stdout == f"{out}: 2 episodes, 8 steps\n", done.stderr
    read = pq.read_table(out)
    assert read["journal"].to_pylist() == ["a.mcap"] * 5 + ["b.mcap"] * 5
    assert read["episode"].to_pylist() == [0] * 5 + [1] * 5
    assert read["seed"].to_pylist() == [0] * 5 + [1] * 5
    assert read["time"].to_pylist() == [0.0, 0.02, 0.04, 0.06, 0.08] * 2
    assert read["reward"].null_count == read["action.collective"].null_count == 2
    spec = EnvSpec.from_json(pq.read_schema(out).metadata[b"env_spec"].decode())
    assert spec.options["episode_length"] == 4
    assert {f"telemetry.{name}" for name in spec.telemetry[-1].components} < {*read.column_names}


@pytest.fixture(scope="module")
def journals(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of journals: whole, of other options, not to the end of an episode, and none."""
    folder = tmp_path_factory.mktemp("journals")
    for name, length, most in (("good", 4, 4), ("other", 5, 5), ("short", 5, 2)):
        with recording(folder / f"{name}.mcap", episode_length=length) as remote:
            fly_one(remote, [1], most)
    (folder / "notes.mcap").write_text("no journal at all")
    before_the_first_chunk = (folder / "good.mcap").read_bytes()[:100]
    (folder / "cut.mcap").write_bytes(before_the_first_chunk)
    return folder


def refused(*words: object) -> str:
    """The one line that the program answers."""
    done = run(*words)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    return done.stderr


@each("names, sentence", "dataset")
def test_wrong_journals_are_one_sentence(
    journals: Path, tmp_path: Path, names: list[str], sentence: str
) -> None:
    out = tmp_path / "new.parquet"
    paths = [journals / name for name in names]
    assert sentence in refused(*paths, "--to", "parquet", "--out", out)
    assert not out.exists()


def test_a_wrong_place_is_one_sentence(journals: Path, tmp_path: Path) -> None:
    there = tmp_path / "there.parquet"
    there.write_bytes(b"mine")
    words = (journals / "good.mcap", "--to", "parquet", "--out")
    expected = f"expected the name of a new file, got {there}, which exists"
    assert expected in refused(*words, there)
    assert there.read_bytes() == b"mine"
    assert "a folder that exists" in refused(*words, tmp_path / "no" / "new.parquet")
    wrong = ("--to", "minari", "--out", "some/flight-v0", "--vehicle", "nobodys.toml")
    expected = "vehicle: cannot read nobodys.toml: No such file"
    assert expected in refused(journals / "good.mcap", *wrong)


def test_a_write_that_fails_names_the_file_and_leaves_none(journals: Path, tmp_path: Path) -> None:
    out = tmp_path / "flight.parquet"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    episodes = RecordedEpisodes([journals / "good.mcap"])
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))  # bytes, of any file
    try:
        with pytest.raises(OSError, match="too large") as error:
            write_parquet(episodes, out)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert error.value.filename == str(out)
    assert not out.exists()


@pytest.mark.usefixtures("minari")
def test_minari_needs_an_id_that_is_new(journals: Path) -> None:
    paths = [journals / "good.mcap"]
    for wrong in ("../flight-v0", "a/flight-v0", "flight", "rotorgram/flight-v"):
        with pytest.raises(InputError, match="out: expected an id of Minari"):
            write_minari(RecordedEpisodes(paths), wrong)
    write_minari(RecordedEpisodes(paths), "flight-v0")
    with pytest.raises(InputError, match="out: expected the id of a new data set"):
        write_minari(RecordedEpisodes(paths), "flight-v0")
