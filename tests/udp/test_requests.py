"""Requests for events: an agent asks, the simulator of its owner's choice obeys."""

import socket
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from peers import ANY, Running
from relay import FaultConfig, relaying
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.single import SingleEnv
from rotorgram.models.errors import InputError
from rotorgram.udp import LinkConfig, RemoteEnv, RemoteVectorEnv, Simulator
from rotorgram.udp.journal.replay import Verification
from rotorgram.udp.layouts import layout_of
from rotorgram.udp.protocol import binary
from rotorgram.udp.protocol.errors import DecodeError
from rotorgram.udp.protocol.messages import Command

HOVER = "rotorgram/Hover-v0"
MASS = 20.0  # kg
EVENTS = (
    {"kind": "kick", "when": "asked", "impulse": (10.0, 0.0, 0.0)},
    {"kind": "mass", "at": 0.2, "mass": -1.0},
    {"kind": "rotor", "when": "asked", "rotor": 1, "share": 0.9, "duration": 0.1},
)
OPTIONS: dict[str, Any] = {"events": EVENTS, "start_tilt": 0.0, "flight_band": 100.0}
LOSSY = FaultConfig(drop=0.1, duplicate=0.05, reorder=0.05, seed=4)


@pytest.mark.parametrize("compiled", [False, True])
def test_a_kick_on_request_in_process(compiled: bool) -> None:
    with closing(SingleEnv(HOVER, compiled=compiled, **OPTIONS)) as env:
        assert env.env_spec.asks == ("kick", "", "rotor")
        env.reset(seed=0)
        still = np.zeros(4, np.float32)
        gained = []
        before = env.step(still)[4]["vx"]
        for asking in (True, False, True):  # as often as it is asked for
            if asking:
                env.ask(0)
            now = env.step(still)[4]["vx"]
            gained.append(now - before)
            before = now
        assert gained == pytest.approx([10.0 / MASS, 0.0, 10.0 / MASS], abs=1e-6)


def test_a_request_of_some_drones() -> None:
    with closing(LocalVectorEnv(HOVER, 3, **OPTIONS)) as env:
        env.reset(seed=0)
        env.ask(0, np.array([False, True, False]))
        env.step(np.zeros((3, 4), np.float32))
        assert env.telemetry["velocity"][:, 0] == pytest.approx([0.0, 10.0 / MASS, 0.0], abs=1e-6)


def test_what_is_not_on_offer_is_refused() -> None:
    with closing(SingleEnv(HOVER, **OPTIONS)) as env:
        for event in (1, 3, -1):
            with pytest.raises(InputError, match=r"one of \[0, 2\], got"):
                env.ask(event)
    with closing(SingleEnv(HOVER)) as env, pytest.raises(InputError, match=r"one of \[\], got 0"):
        env.ask(0)


def test_the_same_bits_over_a_wire_that_loses_and_in_the_replay(tmp_path: Path) -> None:
    file = tmp_path / "flight.mcap"
    local = LocalVectorEnv(HOVER, 4, **OPTIONS)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(ANY)
        agent = taken.getsockname()
    with relaying(agent, LOSSY) as relay:
        simulator = Simulator(
            HOVER, server=relay.address, bind=ANY, num_envs=4, allow_events=True, record=file,
            config=LinkConfig(timeout=60), **OPTIONS,
        )  # fmt: skip
        running = Running(simulator)
        with closing(RemoteVectorEnv(agent)) as remote, closing(local):
            dice = np.random.default_rng(2)
            for env in (local, remote):
                env.reset(seed=4)
            kicked = 0
            for _ in range(30):
                actions = dice.uniform(-0.1, 0.1, (4, 4)).astype(np.float32)
                event = int(dice.choice([0, 2]))
                asking = dice.random(4) < 0.3
                kicked += int(asking.sum()) if event == 0 else 0
                for env in (local, remote):
                    env.ask(event, asking)
                    env.step(actions)
                for name, values in local.telemetry.items():
                    assert remote.telemetry[name].tobytes() == values.tobytes()
            assert kicked > 10
        running.join()
    assert Verification(file).identical


def flown_by(simulator: Simulator, agent: Any, event: int) -> float:
    """Speed along x after a step with a request."""
    running = Running(simulator)
    with closing(RemoteEnv(agent)) as env:
        env.reset(seed=0)
        try:
            env.ask(event)
            speed = float(env.step(np.zeros(4, np.float32))[4]["vx"])
        finally:
            env.step(np.zeros(4, np.float32))  # it flies on
    running.join()
    return speed


@pytest.mark.parametrize("allowed", [True, False])
def test_only_where_the_owner_of_the_simulator_allows_it(allowed: bool) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(ANY)
        agent = taken.getsockname()
    simulator = Simulator(HOVER, server=agent, bind=ANY, allow_events=allowed, **OPTIONS)
    assert simulator.spec.asks == (("kick", "", "rotor") if allowed else ())
    if allowed:
        assert flown_by(simulator, agent, 0) == pytest.approx(10.0 / MASS, abs=1e-6)
    else:
        with pytest.raises(InputError, match=r"one of \[\], got 0"):
            flown_by(simulator, agent, 0)


def test_beyond_this_machine_with_a_key_alone() -> None:
    sentence = r"is not a loopback address: .* or a key .*, where agents ask for events$"
    for insecure in (False, True):
        with pytest.raises(InputError, match=sentence):
            Simulator(
                HOVER, server=("192.0.2.1", 9), bind=ANY, allow_events=True, insecure=insecure,
                **OPTIONS,
            )  # fmt: skip
    Simulator(HOVER, server=("192.0.2.1", 9), bind=("0.0.0.0", 0), insecure=True, **OPTIONS).close()


def test_text_carries_no_request() -> None:
    with pytest.raises(InputError, match=r"^allow_events: expected the binary codec, got text$"):
        Simulator(HOVER, bind=ANY, allow_events=True, codec="text", **OPTIONS)


@pytest.mark.parametrize("bits", [2, 8, 1 << 63])
def test_a_request_for_another_event_is_no_command(bits: int) -> None:
    with closing(SingleEnv(HOVER, **OPTIONS)) as env:
        layout = layout_of(env.env_spec)
    command = Command(
        session=1,
        sequence=1,
        actions=np.zeros((1, 4), np.float32),
        orders=np.zeros(1, np.uint8),
        asks=np.array([5], np.uint64),
    )
    data = binary.encode(command, layout)
    assert binary.decode(data, layout).asks.tolist() == [5]  # type: ignore[union-attr]
    command.asks = np.array([bits], np.uint64)
    sentence = f"requests: expected bits of 0x5, got {bits:#x}"
    with pytest.raises(InputError, match=sentence):
        binary.encode(command, layout)
    layout.asked_bits |= bits
    sent = binary.encode(command, layout)
    layout.asked_bits = 5
    with pytest.raises(DecodeError, match=sentence):
        binary.decode(sent, layout)
