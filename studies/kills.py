"""A hundred random kills (SIGKILL) of a training's two sides, and Ctrl-C at either.

    python studies/kills.py [--kills 100] [--interrupts 20] [--out FILE.json]

A simulator (`rotorgram sim`) and an agent (`rotorgram train a2c --listen`), each in a process of
its own, are killed at random moments and started again by the same command, the agent with
`--resume`.

* In the first half only the agent is killed. At its end the weights, the optimizer's state and the
  finished episodes have to be those of a training that nobody disturbed, bit for bit.
* In the second half either side is killed, or both.

After every kill the checkpoint has to load, the episodes before it have to be there, unchanged, and
the training has to advance within a minute. Then Ctrl-C: both sides have to end within a second.

It takes about ten minutes on two cores.
"""

import json
import random
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import ClassVar

import pandas as pd
from measuring import RESULTS, free_ports, options, write
from rotorgram.agents.checkpoints import load

COLUMNS = ["episode", "first_step", "length", "total_reward"]
HANG = 60.0  # s


class Pair:
    """The two sides, and what they have written so far."""

    living: ClassVar[list["Pair"]] = []

    def __init__(self, folder: Path, env_steps: int) -> None:
        self.living.append(self)
        self.folder = folder
        self.env_steps = env_steps
        self.agent_port, self.simulator_port = free_ports(2)
        self.log = open(folder.with_suffix(".log"), "a")  # noqa: SIM115
        self.agent = self.simulator = None
        self.before = pd.DataFrame(columns=COLUMNS)

    def start(self, *words: object) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "rotorgram.cli", *map(str, words)]
        return subprocess.Popen(command, stdout=self.log, stderr=self.log, start_new_session=True)

    def start_simulator(self) -> None:
        self.simulator = self.start(
            "sim", "--server", f"127.0.0.1:{self.agent_port}",
            "--bind", f"127.0.0.1:{self.simulator_port}",
        )  # fmt: skip

    def start_agent(self) -> None:
        listen = ("--listen", f"127.0.0.1:{self.agent_port}", "--store-every", 1)
        if (self.folder / "checkpoint.safetensors").exists():
            self.agent = self.start("train", "a2c", "--resume", self.folder, *listen)
            return
        shutil.rmtree(self.folder, ignore_errors=True)  # killed before the first update
        self.agent = self.start(
            "train", "a2c", "--out", self.folder, "--env-steps", self.env_steps, *listen
        )

    def kill(self, sides: str) -> None:
        for side in sides:
            process = self.agent if side == "a" else self.simulator
            process.kill()
            process.wait()
        for side in sides:
            self.start_agent() if side == "a" else self.start_simulator()

    def done(self) -> int:
        """Env steps at the last checkpoint, which has to load."""
        path = self.folder / "checkpoint.safetensors"
        return load(path).position.env_steps if path.exists() else 0

    def check(self) -> None:
        """The episodes before the checkpoint are there, and as they were."""
        path = self.folder / "checkpoint.safetensors"
        if not path.exists():
            return
        count = len(load(path).position.episodes)
        table = pd.read_csv(self.folder / "episodes.csv")[COLUMNS][:count]
        assert table.episode.tolist() == list(range(count)), "episodes are missing"
        known = self.before[: len(table)].reset_index(drop=True)
        pd.testing.assert_frame_equal(known, table[: len(known)], check_dtype=False)
        self.before = table

    def wait_for_progress(self, beyond: int) -> float:
        began = time.monotonic()
        while self.done() <= beyond and self.agent.poll() != 0:
            assert self.agent.poll() is None, f"the agent failed: {self.agent.poll()}"
            assert time.monotonic() - began < HANG, f"no progress beyond {beyond} env steps"
            time.sleep(0.05)
        return time.monotonic() - began

    def finish(self) -> None:
        assert self.agent.wait(600) == 0, "the agent failed"
        assert self.simulator.wait(30) == 0, "the simulator failed"


def unbroken(folder: Path, env_steps: int) -> None:
    pair = Pair(folder, env_steps)
    pair.start_simulator()
    pair.start_agent()
    pair.finish()


def identical(one: Path, other: Path) -> bool:
    here, there = (load(f / "checkpoint.safetensors").state for f in (one, other))
    states = here.keys() == there.keys() and all(
        here[name].tobytes() == there[name].tobytes() for name in here
    )
    tables = [pd.read_csv(f / "episodes.csv")[COLUMNS] for f in (one, other)]
    return states and tables[0].equals(tables[1])


def kill_often(
    folder: Path, env_steps: int, kills: int, sides: list[str], dice: random.Random
) -> dict[str, object]:
    pair = Pair(folder, env_steps)
    pair.start_simulator()
    pair.start_agent()
    back = []
    counts = dict.fromkeys(sides, 0)
    for number in range(1, kills + 1):
        before = pair.done()
        pair.wait_for_progress(before)
        time.sleep(dice.uniform(0.0, 1.5))
        if pair.agent.poll() is not None:
            raise RuntimeError(f"training was over after {number - 1} kills: use more env steps")
        side = dice.choice(sides)
        counts[side] += 1
        at = pair.done()
        pair.kill(side)
        pair.check()
        back.append(pair.wait_for_progress(at))
        pair.check()
        print(f"{folder.name}: kill {number:3} of {kills} ({side}) at {at:,} env steps, "
              f"advancing again after {back[-1]:.1f} s", flush=True)  # fmt: skip
    pair.finish()
    pair.check()
    episodes = pd.read_csv(folder / "episodes.csv")
    return {
        "kills": {"agent": counts.get("a", 0), "simulator": counts.get("s", 0),
                  "both": counts.get("as", 0)},
        "env_steps": env_steps,
        "finished_episodes": len(episodes),
        "episodes_missing": len(set(range(len(episodes))) - set(episodes.episode)),
        "seconds_until_advancing_again": {
            "median": round(statistics.median(back), 2), "longest": round(max(back), 2)},
    }  # fmt: skip


def interrupt(folder: Path, side: str, dice: random.Random) -> float:
    """Seconds from Ctrl-C at one side until both have ended."""
    pair = Pair(folder, 10_000_000)
    pair.start_simulator()
    pair.start_agent()
    pair.wait_for_progress(0)
    time.sleep(dice.uniform(0.0, 1.0))
    process = pair.agent if side == "agent" else pair.simulator
    began = time.monotonic()
    process.send_signal(signal.SIGINT)
    for one in (pair.agent, pair.simulator):
        one.wait(30)
    seconds = time.monotonic() - began
    pair.check()
    assert pair.done() > 0
    return seconds


def main() -> None:
    defaults = {"kills": 100, "interrupts": 20, "env_steps": 500_000, "seed": 0}
    args = options(__doc__, **defaults, out=RESULTS / "reliability" / "kills.json").parse_args()
    # In a shell's background it is ignored, by the children too.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    dice = random.Random(args.seed)
    root = Path(tempfile.mkdtemp())
    half = args.kills // 2
    agent = kill_often(root / "agent", args.env_steps, half, ["a"], dice)
    unbroken(root / "unbroken", args.env_steps)
    agent["identical_to_unbroken"] = identical(root / "agent", root / "unbroken")
    either = kill_often(root / "either", args.env_steps, args.kills - half, ["a", "s", "as"], dice)
    interrupts = {
        side: [
            round(interrupt(root / f"{side}{i}", side, dice), 3)
            for i in range(args.interrupts // 2)
        ]
        for side in ("agent", "simulator")
    }
    result = {
        "agent_killed": agent,
        "either_killed": either,
        "seconds_from_ctrl_c_to_both_ended": {
            side: {"median": statistics.median(times), "longest": max(times), "times": len(times)}
            for side, times in interrupts.items()
            if times
        },
    }
    write(args.out, result)
    print(json.dumps(result, indent=2))
    shutil.rmtree(root)
    late = [t for times in interrupts.values() for t in times if t > 1.0]
    if late or not agent["identical_to_unbroken"]:
        sys.exit(1)


if __name__ == "__main__":
    try:
        main()
    finally:
        for pair in Pair.living:
            for process in (pair.agent, pair.simulator):
                if process:
                    process.kill()
