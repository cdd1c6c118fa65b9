"""One world flown by several agents over UDP: the bits of the world in process, whoever is lost."""

import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from peers import ANY, TABLES, Running, launch
from relay import FaultConfig, relaying
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.loop import Loop
from rotorgram.models import InputError
from rotorgram.udp import (
    LinkConfig,
    RemoteEnv,
    RemoteVectorEnv,
    Simulator,
)
from rotorgram.udp.journal.replay import Verification
from rotorgram.udp.protocol.auth import write_key
from rotorgram.udp.protocol.messages import Command
from rotorgram.udp.remote_parallel import RemoteParallelEnv
from swarms import RISE

LOSSY = FaultConfig(drop=0.3, duplicate=0.1, reorder=0.1, seed=3)
LONG = 150  # control steps of an episode in which somebody is lost
Step = tuple[bytes, float, bool, bool]
VICTIM = """
    import sys, time
    import numpy as np
    from rotorgram.udp import RemoteEnv

    port = int(sys.argv[1])
    env = RemoteEnv(("127.0.0.1", port), connect_timeout=60)
    for episode in range(3):
        env.reset(seed=episode)
        print("begun", flush=True)
        truncated, steps = False, 0
        while not truncated:
            time.sleep(0.01)
            _, reward, _, truncated, _ = env.step(np.zeros(1, np.float32))
            steps += 1
            print("cut" if truncated and not reward else steps, flush=True)
"""


def free_ports(count: int) -> list[tuple[str, int]]:
    with ExitStack() as stack:
        socks = [
            stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            for _ in range(count)
        ]
        for sock in socks:
            sock.bind(ANY)
        return [sock.getsockname() for sock in socks]


@contextmanager
def shared(
    agents: list[tuple[str, int]], drones: int, faults: FaultConfig | None = None, **rest: Any
) -> Iterator[Running]:
    """A simulator of these agents in a thread, which ends with the last of them."""
    with ExitStack() as stack:
        if faults:
            agents = [stack.enter_context(relaying(a, faults)).address for a in agents]
        rest = {"patience": 20.0, "config": LinkConfig(timeout=60), **rest}
        running = Running(Simulator(RISE, agents=agents, drones=drones, bind=ANY, **rest))
        try:
            yield running
        finally:
            running.simulator.stop()
            running.join()


def in_threads(flights: list[Callable[[], None]]) -> None:
    errors: list[BaseException] = []

    def guarded(flight: Callable[[], None]) -> None:
        try:
            flight()
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=guarded, args=(flight,)) for flight in flights]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    assert not errors, errors
    assert not any(thread.is_alive() for thread in threads)


def action_of(drone: int, episode: int, step: int) -> np.ndarray:
    """The higher its number, the faster it climbs, and the sooner it is out."""
    dice = np.random.default_rng((drone, episode, step))
    level = 0.3 + 0.1 * drone
    share = dice.uniform(0.9, 1.0, 1).astype(np.float32)
    return level * share


def calm(drone: int, episode: int, step: int) -> np.ndarray:
    dice = np.random.default_rng((drone, episode, step))
    action = dice.uniform(-0.1, 0.1, 1)
    return action.astype(np.float32)


def fly_one(
    address: tuple[str, int], drone: int, episodes: int, seen: dict[int, list[list[Step]]],
    act: Callable[[int, int, int], np.ndarray] = action_of, **settings: Any,
) -> None:  # fmt: skip
    env = RemoteEnv(address, connect_timeout=60, **settings)
    for episode in range(episodes):
        observation, _ = env.reset(seed=100 * drone + episode)
        flight: list[Step] = [(observation.tobytes(), 0.0, False, False)]
        while not (flight[-1][2] or flight[-1][3]):
            observation, *told, _ = env.step(act(drone, episode, len(flight) - 1))
            flight.append((observation.tobytes(), *told))
        seen.setdefault(drone, []).append(flight)
    env.close()


def fly_several(
    address: tuple[str, int], names: list[str], episodes: int, seen: dict[int, list[list[Step]]]
) -> None:
    env = RemoteParallelEnv(address, connect_timeout=60)
    assert env.possible_agents == names
    for episode in range(episodes):
        first = int(names[0][-1])
        observations, _ = env.reset(seed=100 * first + episode)
        flights = {n: [(observations[n].tobytes(), 0.0, False, False)] for n in names}
        step = 0
        while env.agents:
            actions = {name: action_of(int(name[-1]), episode, step) for name in env.agents}
            observations, rewards, ends, cuts, _ = env.step(actions)
            for n in observations:
                told = observations[n].tobytes(), rewards[n], ends[n], cuts[n]
                flights[n].append(told)
            step += 1
        for name in names:
            seen.setdefault(int(name[-1]), []).append(flights[name])
    env.close()


def in_process(
    drones: int, episodes: int, act: Callable[[int, int, int], np.ndarray] = action_of,
    lost: tuple[int, int] | None = None, **options: Any,
) -> dict[int, list[list[Step]]]:  # fmt: skip
    """The same in one process; `lost`: a drone, and a step of the first episode."""
    loop = Loop(EnvConfig.from_keywords(RISE, drones=drones, **options))
    seen: dict[int, list[list[Step]]] = {drone: [] for drone in range(drones)}
    for episode in range(episodes):
        nothing = np.zeros((drones, 1), np.float32)
        loop.advance(nothing, np.ones(drones, bool), [episode] * drones)
        rows = loop.observations["observation"]
        flights = [[(rows[i].tobytes(), 0.0, False, False)] for i in range(drones)]
        step = 0
        while not loop.done.all():
            flown = ~loop.out
            actions = nothing.copy()
            for i in range(drones):
                actions[i] = act(i, episode, step)
            if lost and episode == 0 and step >= lost[1]:
                victim = np.arange(drones) == lost[0]
                actions[victim] = 0.0
            loop.advance(actions)
            rows = loop.observations["observation"]
            step = step + 1
            for i in np.flatnonzero(flown):
                told = loop.rewards[i].item(), loop.terminated[i].item(), loop.truncated[i].item()
                flights[i].append((rows[i].tobytes(), *told))
        for i in range(drones):
            seen[i].append(flights[i])
    loop.close()
    return seen


@pytest.mark.parametrize("faults", [None, LOSSY], ids=["clean", "30 % loss and a key"])
def test_an_agent_for_each_drone_is_the_world_in_process(
    faults: FaultConfig | None, tmp_path: Path
) -> None:
    agents = free_ports(8)
    seen = {}
    key: dict[str, Any] = {}
    if faults:
        key = {"key_file": tmp_path / "key"}
        write_key(key["key_file"])
    with shared(agents, 8, faults, episode_length=60, **key) as running:
        in_threads([lambda a=a, i=i: fly_one(a, i, 2, seen, **key) for i, a in enumerate(agents)])
        assert running.join() == "the agent closed"
        assert running.simulator.rules.episodes == 2
    expected = in_process(8, 2, episode_length=60)
    assert len({len(flights[0]) for flights in expected.values()}) > 6  # one after the other
    assert seen == expected


def heard(process: subprocess.Popen[str], word: str) -> None:
    assert process.stdout is not None
    for line in process.stdout:
        if line.strip() == word:
            return
    raise AssertionError(f"never said {word}: {process.stderr.read()}")


def test_drones_of_one_that_is_killed_hold_and_it_comes_back() -> None:
    agents = free_ports(3)
    seen = {}
    others = [threading.Thread(target=fly_one, args=(agents[i], i, 3, seen, calm)) for i in (0, 2)]
    victim = launch(VICTIM, agents[1][1])
    with shared(agents, 3, episode_length=LONG, patience=1.0) as running:
        rules = running.simulator.rules
        lost: list[tuple[int, int]] = []  # episodes, and steps that were flown without the victim

        def watch(cause: Command) -> None:
            if not cause.resets.any() and rules.links[1].participation != "flying":
                lost.append((rules.episodes, rules.steps))

        running.simulator.observers.append(watch)
        for thread in others:
            thread.start()
        heard(victim, "20")
        victim.send_signal(signal.SIGKILL)
        again = launch(VICTIM, agents[1][1])
        heard(again, "20")  # of a later episode
        for thread in others:
            thread.join(60)
    for process in (victim, again):
        process.kill()
        process.communicate()
    episode, step = lost[0]
    flown = step - 1
    assert episode == 1
    assert 20 <= flown < LONG - 1
    expected = in_process(3, 3, calm, (1, flown), episode_length=LONG)
    assert [seen[i][0] for i in (0, 2)] == [expected[i][0] for i in (0, 2)]
    assert lost[: LONG - flown] == [(1, step) for step in range(flown + 1, LONG + 1)]


def test_the_command_flies_the_world_of_several_agents() -> None:
    agents = free_ports(2)
    seen = {}
    where = [f"127.0.0.1:{port}" for _, port in agents]
    command = [sys.executable, "-m", "rotorgram.cli", "sim", "--env", "swarms:swarm/Rise-v0",
               "--drones", "2", "--bind", "127.0.0.1:0", "--agents", *where]  # fmt: skip
    pipe = subprocess.PIPE
    here = Path(__file__).parents[1]
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, cwd=here) as simulator:
        in_threads([lambda a=a, i=i: fly_one(a, i, 1, seen) for i, a in enumerate(agents)])
        out, err = simulator.communicate(timeout=30)
    assert simulator.returncode == 0
    assert err == ""
    first, closed, *wires = out.splitlines()
    assert first.startswith("simulating at 127.0.0.1:")
    assert first.endswith(" for 2 agents (Ctrl-C ends)")
    assert closed == "the agent closed"
    assert [wire.split(": ")[0] for wire in wires] == [f"wire to {one}" for one in where]
    assert seen == in_process(2, 1)


def test_a_journal_of_a_part_of_a_world_cannot_be_simulated_and_says_so_briefly(
    tmp_path: Path,
) -> None:
    agents = free_ports(2)
    journal = tmp_path / "part.mcap"

    def begin(address: tuple[str, int], **settings: Any) -> None:
        with closing(RemoteVectorEnv(address, connect_timeout=60, **settings)) as env:
            env.reset(seed=0)

    formation = Simulator("rotorgram/Formation-v0", agents=agents, drones=4, bind=ANY)
    running = Running(formation)
    in_threads([lambda: begin(agents[0], record=journal), lambda: begin(agents[1])])
    assert running.join() == "the agent closed"
    verdict = Verification(journal)
    assert not verdict.identical
    told = str(verdict).splitlines()
    assert told[1].startswith("  State 1 cannot be repeated: expected an env of the observation ")
    assert len(told[1]) < 300


def test_agents_of_several_drones_each() -> None:
    agents = free_ports(2)
    seen = {}
    halves = [["drone_0", "drone_1"], ["drone_2", "drone_3"]]
    flights = [
        lambda a=a, names=names: fly_several(a, names, 1, seen)
        for a, names in zip(agents, halves, strict=True)
    ]
    with shared(agents, 4):
        in_threads(flights)
    assert seen == in_process(4, 1)


def test_who_is_waited_for_is_told_soon(caplog: pytest.LogCaptureFixture) -> None:
    there, late = free_ports(2)
    with shared([there, late], 2), closing(RemoteEnv(there, connect=False)) as env:
        first = threading.Thread(target=env.reset)
        first.start()
        while not caplog.messages:
            assert first.is_alive()
        with closing(RemoteEnv(late)) as other:
            other.reset()
        first.join(60)
    where = f"127.0.0.1:{late[1]}"
    expected = (
        rf"no answer from the agent at {where} for 1 s, Hello sent \d+ times; asking for 60 s"
    )
    assert re.match(expected, caplog.messages[0])


@pytest.mark.parametrize(("changes", "sentence"), TABLES["wrong arguments of a shared world"])
def test_wrong_arguments_are_told(changes: dict[str, Any], sentence: str) -> None:
    given = {"env": RISE, "agents": [("127.0.0.1", 1)], "drones": 3, "bind": ANY, **changes}
    given["agents"] = [tuple(agent) for agent in given["agents"]]
    with pytest.raises(InputError) as told:
        Simulator(**given)
    assert str(told.value).startswith(sentence)


def test_this_side_is_no_agent() -> None:
    (here,) = free_ports(1)
    for several in ({"agents": [here]}, {"server": here}):
        with pytest.raises(InputError, match="server: expected the address of an agent, got that"):
            Simulator(RISE, bind=here, **several)
