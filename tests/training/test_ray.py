"""A study on a Ray cluster: two nodes of one core each, on this machine."""

import os
import secrets
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pytest
from rotorgram.agents.checkpoints import load
from rotorgram.envs.config import EnvConfig
from rotorgram.flights import ray_cluster as module
from rotorgram.flights.executors import RunsFailed, WorkersConfig, open_executor, run_jobs
from rotorgram.flights.folders import new_folder
from rotorgram.models.files import software_versions
from rotorgram.training.results import Results
from rotorgram.training.settings import Row, Study
from rotorgram.training.study import run_study

# Ray listens beyond this machine. It reads these when it is imported.
os.environ |= {
    "RAY_AUTH_MODE": "token",
    "RAY_AUTH_TOKEN": secrets.token_hex(32),
    "RAY_USAGE_STATS_ENABLED": "0",
}
ray = pytest.importorskip("ray", reason="needs Ray: pip install 'rotorgram[ray]'")

ENV = EnvConfig(episode_length=50)
A2C = Row(agent="a2c", name="a2c", env=ENV, env_steps=600)
PID = Row(agent="pid", name="pid", env=ENV)
STUDY = Study(
    rows=(A2C, PID),
    seeds=1, snapshots=1, curve_episodes=1, episodes=1, wire=True, keep_steps=True,
)  # fmt: skip
TIMES = ["seconds", "steps_per_second", "seconds_to_hold"]


def nothing(*_: object) -> None:
    """No progress is shown."""


CLUSTER = """
import sys
from ray.cluster_utils import Cluster

cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
cluster.add_node(num_cpus=1)
print("at", cluster.address, flush=True)
sys.stdin.read()
cluster.shutdown()
"""


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    # In a process of its own: it leaves pipes and processes open, which are errors in ours.
    command = [sys.executable, "-c", CLUSTER]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as process:
        assert process.stdout is not None
        words = next(line for line in process.stdout if line.startswith("at "))
        yield words.split()[1]


def test_the_numbers_are_those_of_this_machine(tmp_path: Path, address: str) -> None:
    shown = []
    on_ray, here = (new_folder(tmp_path / name, "compare") for name in ("ray", "here"))
    workers = WorkersConfig(runner="ray", address=address)
    run_study(STUDY, on_ray, workers, "", lambda name, _, __, words: shown.append((name, words)))
    run_study(STUDY, here, workers=WorkersConfig(jobs=1))
    assert {("a2c seed 0", "done"), ("pid seed 0", "done")} <= {*shown}
    a, b = Results.read(on_ray), Results.read(here)
    assert len(a.episodes) > 5
    for table in ("episodes", "evaluations", "runs"):
        left, right = (
            getattr(results, table).drop(columns=TIMES, errors="ignore") for results in (a, b)
        )
        pd.testing.assert_frame_equal(left, right, check_exact=True)
    for phase in ("train", "evaluation"):
        left = a.steps(phase)
        right = b.steps(phase)
        pd.testing.assert_frame_equal(left, right, check_exact=True)
    name = "checkpoints/a2c-seed0.safetensors"
    actor = load(on_ray / name).actor
    other = load(here / name).actor
    assert actor.keys() == other.keys()
    for key, array in actor.items():
        assert array.tobytes() == other[key].tobytes()


def test_every_node_flies(address: str) -> None:
    def node(job: int, _: object) -> tuple[int, str]:
        time.sleep(0.5)
        return job, ray.get_runtime_context().get_node_id()

    config = WorkersConfig(runner="ray", address=address)
    found: list[tuple[int, str]] = []
    with open_executor(config, 4) as executor:
        jobs = {f"job {n}": n for n in range(4)}
        run_jobs(executor, node, jobs, lambda _, value: found.append(value), nothing)
    assert sorted(job for job, _ in found) == [0, 1, 2, 3]
    assert len({where for _, where in found}) == 2


@pytest.mark.parametrize("package", ["numpy", "one-that-it-lacks"])
def test_a_worker_with_other_software_is_refused(
    package: str, tmp_path: Path, address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = software_versions()
    monkeypatch.setattr(module, "software_versions", lambda: {**here, package: "0.1"})
    workers = WorkersConfig(runner="ray", address=address)
    got = here.get(package, "none")
    sentence = f"{package}: expected version 0.1 .*, got {got} on {socket.gethostname()}"
    with pytest.raises(RunsFailed, match=f"2 of 2 runs failed: .*{sentence}"):
        run_study(STUDY, tmp_path, workers=workers)


def test_ctrl_c_ends_workers_and_simulators(tmp_path: Path, address: str) -> None:
    folder = tmp_path / "out"
    where = ["--runner", "ray", "--address", address]
    settings = ["--agents", "a2c", "--seeds", "2", "--env-steps", "1000000", "--out", str(folder)]
    before = set(_simulators())  # of workers that other tests have used
    process = subprocess.Popen(
        [sys.executable, "-m", "rotorgram.cli", "compare", *settings, *where],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    try:
        deadline = time.monotonic() + 60
        while len(simulators := set(_simulators()) - before) < 2:
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.1)
        os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=20)
    finally:
        process.kill()
    assert process.returncode == 130, err
    assert err == "rotorgram: interrupted\n"
    assert f"go on with: rotorgram compare --resume {folder}" in out
    deadline = time.monotonic() + 10
    while any(Path(f"/proc/{simulator}").exists() for simulator in simulators):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def _simulators() -> list[int]:
    """Simulators that descend from this process, whose children the nodes are."""
    listing = subprocess.run(
        ["ps", "-ewwo", "pid,ppid,args"], capture_output=True, text=True, check=True
    )
    rows = [line.split(None, 2) for line in listing.stdout.splitlines()[1:]]
    parents = {int(pid): int(parent) for pid, parent, _ in rows}

    def is_ours(pid: int) -> bool:
        return pid == os.getpid() or (pid in parents and is_ours(parents[pid]))

    return [int(p) for p, _, words in rows if "-m rotorgram.udp" in words and is_ours(int(p))]


def test_no_such_cluster(tmp_path: Path) -> None:
    with socket.socket() as sock:  # bound, but nobody listens
        sock.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{sock.getsockname()[1]}"
        sentence = f"address: expected a Ray cluster at {address}, got: Connection refused"
        workers = WorkersConfig(runner="ray", address=address)
        with pytest.raises(ValueError, match=sentence):
            run_study(STUDY, tmp_path, workers=workers)
    assert not list(tmp_path.iterdir())


def test_no_ray(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ImportError, match=r"pip install 'rotorgram\[ray\]'"):
        run_study(STUDY, tmp_path, workers=WorkersConfig(runner="ray"))


def test_an_address_is_of_a_cluster() -> None:
    with pytest.raises(ValueError, match="address: expected it with runner ray"):
        WorkersConfig(address="auto")
