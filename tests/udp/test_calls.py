"""Python calls of one step of one drone over UDP, which cost more than the simulation."""

import sys
import threading
from collections import Counter
from contextlib import closing
from pathlib import Path
from types import FrameType

import numpy as np
from peers import ANY, Running
from rotorgram.udp import RemoteEnv, Simulator, protocol

UDP = str(Path(protocol.__file__).parents[1])
STEPS, MOST = 20, 40


def test_a_step_of_one_drone_takes_few_calls() -> None:
    counts: Counter[str] = Counter()
    counting = False

    def profile(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        caller = frame.f_back.f_code.co_filename if frame.f_back else ""
        ours = code.co_filename.startswith(UDP) or caller.startswith(UDP)
        if counting and event == "call" and ours and "/envs/" not in code.co_filename:
            counts[code.co_qualname] += 1

    with closing(RemoteEnv(ANY, connect=False, timeout=5)) as remote:
        threading.setprofile(profile)
        running = Running(Simulator(server=remote.address, bind=ANY))
        threading.setprofile(None)  # type: ignore[arg-type]
        remote.reset(seed=1)
        action = np.zeros(1, np.float32)
        sys.setprofile(profile)
        try:
            for _ in range(5):
                remote.step(action)
            counting = True
            for _ in range(STEPS):
                remote.step(action)
            counting = False
        finally:
            sys.setprofile(None)
    running.join()
    assert {"Driver._fly", "RemoteEnv.step", "encode_state"} & counts.keys() == {
        "RemoteEnv.step", "encode_state"
    }  # fmt: skip
    # A resend of a slow machine adds a few.
    assert sum(counts.values()) / STEPS <= MOST, counts
