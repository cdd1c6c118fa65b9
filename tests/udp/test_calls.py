"""Python calls of one step of one drone over UDP, which cost more than the simulation."""

import sys
import threading
from collections import Counter
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from statistics import median
from types import FrameType

import numpy as np
from peers import ANY, simulate
from rotorgram.udp import RemoteEnv, protocol

UDP = str(Path(protocol.__file__).parents[1])
STEPS = 41
MOST = 40


def test_a_step_of_one_drone_takes_few_calls() -> None:
    counts: Counter[str] = Counter()

    def profile(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        caller = frame.f_back.f_code.co_filename if frame.f_back else ""
        ours = code.co_filename.startswith(UDP) or caller.startswith(UDP)
        if event == "call" and ours and "/envs/" not in code.co_filename:
            counts[code.co_qualname] += 1

    totals = []
    with closing(RemoteEnv(ANY, connect=False, timeout=5)) as remote:
        threading.setprofile(profile)
        running = simulate(remote)
        threading.setprofile(None)  # type: ignore[arg-type]
        remote.reset(seed=1)
        action = np.zeros(1, np.float32)
        sys.setprofile(profile)
        try:
            for _ in range(STEPS):
                remote.step(action)
                totals.append(sum(counts.values()))
        finally:
            sys.setprofile(None)
    running.join()
    assert counts["RemoteEnv.step"] == STEPS
    assert counts["encode_step"] >= STEPS  # the other side is counted too
    # The median: a busy machine sends some messages again.
    assert 20 < median(after - before for before, after in pairwise(totals)) <= MOST, counts
