"""The targets of the fuzzer, with their first inputs and random changes of them."""

import sys
from pathlib import Path
from random import Random

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent / "fuzz"))

from targets import TARGETS, fuzz_one, seeds

INPUTS = list(seeds())


def changed(data: bytes, dice: Random) -> bytes:
    """A few bytes changed, cut out, doubled or taken from another input."""
    buffer = bytearray(data)
    for _ in range(dice.randint(1, 4)):
        at, size = dice.randrange(len(buffer) + 1), dice.randrange(1, 9)
        match dice.randrange(5):
            case 0 if at < len(buffer):
                buffer[at] ^= 1 << dice.randrange(8)
            case 1:
                buffer[at : at + size] = dice.randbytes(size)
            case 2:
                del buffer[at : at + size]
            case 3:
                buffer[at:at] = buffer[at : at + size]
            case 4:
                other = dice.choice(INPUTS)
                buffer[at:] = other[dice.randrange(len(other)) :]
    return bytes(buffer)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("seed", range(4))
def test_changed_inputs_find_nothing(seed: int) -> None:
    dice = Random(seed)
    with np.errstate(all="raise"):
        if seed == 0:
            for data in INPUTS:
                fuzz_one(data)
        for _ in range(1500):
            data = changed(dice.choice(INPUTS), dice)
            try:
                fuzz_one(data)
            except Exception as error:
                raise AssertionError(f"fuzz_one(bytes.fromhex({data.hex()!r}))") from error


def test_every_target_is_reached() -> None:
    assert {data[0] % len(TARGETS) for data in INPUTS} >= {0, 1, 2, 3, 4, 8}
