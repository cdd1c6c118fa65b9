"""What either side was told to require, and what it refuses, in a sentence that names it."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from peers import ANY, ENV_ID, QUICK, TABLES, Running, launch, plain_socket, simulate
from remotes import Broken, flying
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec, register
from rotorgram.envs.tasks import Hover
from rotorgram.models import QUAD_XML
from rotorgram.models.errors import InputError
from rotorgram.udp import LinkError, PeerClosed, Refused, RemoteEnv, RemoteVectorEnv, Simulator
from rotorgram.udp.__main__ import read_arguments
from rotorgram.udp.protocol.messages import Hello
from rotorgram.udp.spawn import spawn_simulator
from rotorgram.udp.transport.agent import AgentConfig

# ---- arguments


KINDS: dict[str, Any] = {
    "Simulator": Simulator, "RemoteEnv": RemoteEnv, "RemoteVectorEnv": RemoteVectorEnv
}  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "arguments", "sentence"),
    [
        *TABLES["wrong arguments"],
        ("Simulator", {"env": Broken(None), "target": 1}, "env: expected one env without keywords"),
        ("RemoteEnv", {"env_id": "Own-v0", "options": {"wind": np.zeros(3)}}, "JSON values"),
        ("RemoteEnv", {"connect_timeout": float("nan")}, "connect_timeout: expected"),
    ],
)
def test_wrong_arguments(kind: str, arguments: dict[str, Any], sentence: str) -> None:
    here = {} if kind == "Simulator" else {"address": ANY}
    given = {**here, **arguments}
    for name in ("address", "server"):
        if name in given:
            given[name] = tuple(given[name])
    with pytest.raises(InputError, match=sentence):
        KINDS[kind](**given)


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        *TABLES["wrong arguments of the simulator program"],
        ("[" * 100_000, "expected a JSON object: maximum recursion depth"),
    ],
)
def test_wrong_arguments_of_the_simulator_program(line: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        read_arguments(line.encode())


def test_arguments_of_the_simulator_program() -> None:
    config = EnvConfig(task={"target": 3.0})
    words = {"config": config.to_dict(), "server": ["127.0.0.1", 5]}
    arguments = read_arguments(json.dumps(words).encode() + b"\n")
    assert arguments == (config, {"server": ["127.0.0.1", 5]})


def test_the_simulator_program_says_which_package_is_missing(tmp_path: Path) -> None:
    code = """
        import runpy, sys
        sys.modules["mcap"] = None
        runpy.run_module("rotorgram.udp", run_name="__main__")
    """
    process = launch(code, stdin=subprocess.PIPE)
    words = {"config": EnvConfig().to_dict(), "record": str(tmp_path / "j")}
    out, err = process.communicate(json.dumps(words) + "\n", timeout=60)
    sentence = "the journal of a flight needs the package mcap: pip install 'rotorgram[record]'"
    assert process.returncode == 1
    assert out == ""
    assert err == f"rotorgram simulator: {sentence}\n"


# ---- fault 4: options are compared both ways


class Own(gym.Env[Any, Any]):
    """An env of somebody else, of which the agent knows nothing."""

    observation_space = spaces.Dict(
        {
            "picture": spaces.Box(0, 255, (4, 4, 3), np.uint8),
            "speed": spaces.Box(-1.0, 1.0, (), np.float64),
        }
    )
    action_space = spaces.Discrete(3)

    def __init__(self, wind: float = 0.0, gusts: int = 1) -> None:
        self.wind = wind

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        assert action in (0, 1, 2)
        picture = np.full((4, 4, 3), action, np.uint8)
        return {"picture": picture, "speed": np.array(0.5)}, 1.0, False, False, {}


gym.register("Own-v0", Own)


def env_of(env_id: str, options: Any) -> dict[str, Any]:
    """Arguments of a simulator of a task of ours, or of an env made by Gymnasium."""
    return (
        {"env": gym.make(env_id, **options)} if env_id == "Own-v0" else {"env": env_id, **options}
    )


def test_options_of_others_are_json_values() -> None:  # fault 3
    with pytest.raises(InputError, match="expected JSON values"):
        Simulator(gym.make("Own-v0", wind=np.zeros(3)), bind=ANY)


WAYPOINTS = [[1.25, -0.5, 0.01 * i] for i in range(40)]


@pytest.mark.parametrize(("wanted", "env", "given", "sentence"), TABLES["refusals"])
def test_refusals_say_why(wanted: Any, env: str, given: Any, sentence: str) -> None:
    with RemoteEnv(ANY, connect=False, connect_timeout=0.6, **wanted) as remote:
        running = simulate(remote, **env_of(env, given))
        with pytest.raises(ConnectionError):
            remote.connect()
        error = running.join()
    assert isinstance(error, Refused)
    assert sentence in str(error)


def test_spaces_in_a_distribution_do_not_differ() -> None:
    wanted = {"randomize": {"mass": "uniform(0.9,1.1)"}}
    with RemoteEnv(ANY, connect=False, env_id=ENV_ID, options=wanted) as remote:
        given = {"randomize": {"mass": " uniform( 0.9, 1.1 )"}}
        running = simulate(remote, **given)
        remote.connect()
        assert remote.env_spec.options["randomize"] == {"mass": "uniform(0.9, 1.1)"}
    running.join()


@pytest.mark.parametrize(
    ("wanted", "env", "given"),
    [
        *TABLES["what fits"],
        ({"options": {"wind": WAYPOINTS}}, "Own-v0", {"wind": WAYPOINTS}),  # fault 3
    ],
)
def test_what_fits_flies(wanted: Any, env: str, given: Any) -> None:
    with RemoteEnv(ANY, connect=False, connect_timeout=5, **wanted) as remote:
        running = simulate(remote, **env_of(env, given))
        remote.reset(seed=1)
        assert remote.env_spec.env_id in (ENV_ID, "Own-v0")
    assert running.join() == "the agent closed"


@pytest.mark.parametrize("env_id", ["evil:Evil-v0", f"evil:{ENV_ID}"])
def test_nothing_that_a_simulator_names_is_imported(
    env_id: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # fault 28
    (tmp_path / "evil.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(str(tmp_path))
    wanted: dict[str, Any] = {"options": {"target": 3.0}, "record": tmp_path / "j"}
    with RemoteEnv(ANY, connect=False, connect_timeout=5, **wanted) as remote:
        simulator = Simulator(server=remote.address, bind=ANY, config=QUICK, target=3.0)
        spec = replace(simulator.spec, env_id=env_id).to_json()
        simulator.link.hello = replace(simulator.link.hello, spec=spec)
        running = Running(simulator)
        remote.reset(seed=1)
        assert remote.env_spec.env_id == env_id
        remote.step(np.zeros(1))
    assert running.join() == "the agent closed"
    assert "evil" not in sys.modules


def test_the_agent_trusts_hello() -> None:
    """Pictures, dicts and choices of an env that this side has no code of."""
    with flying(Own()) as pair:
        observation, info = pair.remote.reset(seed=1)
        assert pair.remote.observation_space == Own.observation_space
        assert pair.remote.action_space == Own.action_space
        assert observation in Own.observation_space
        assert info == {}
        observation, reward, *_ = pair.remote.step(2)
        assert (observation["picture"] == 2).all()
        assert observation["speed"] == 0.5
        assert reward == 1.0


# ---- actions


def test_actions_are_neither_clipped_nor_scaled() -> None:  # fault 6
    seen = []

    class Wide(Own):
        observation_space = spaces.Box(-1, 1, (1,), np.float32)  # type: ignore[assignment]
        action_space = spaces.Box(-9.0, 9.0, (1,), np.float64)  # type: ignore[assignment]

        def step(self, action: Any) -> Any:
            seen.append(action.item())
            return np.zeros(1, np.float32), 0.0, False, False, {}

    with flying(Wide()) as pair:
        pair.remote.reset()
        for action in (0.1, -8.0, 100.0):
            pair.remote.step(np.array([action]))
    assert seen == [0.1, -8.0, 100.0]


# ---- how runs end


def reset_for_ever(remote: RemoteEnv) -> None:
    while True:
        remote.reset()


def test_stop_from_another_thread() -> None:  # fault 7
    with RemoteEnv(ANY, connect=False) as remote:
        running = simulate(remote)
        remote.reset()
        begun = time.monotonic()
        for _ in range(3):
            running.simulator.stop()
        with pytest.raises(PeerClosed, match="closed: the simulator was stopped"):
            reset_for_ever(remote)
        assert time.monotonic() - begun < 2
        assert running.join() == "the simulator was stopped"


def test_a_long_step_is_no_silence() -> None:  # fault 33
    class Slow(Own):
        def step(self, action: Any) -> Any:
            time.sleep(2.6)
            return super().step(action)

    with RemoteEnv(ANY, connect=False, timeout=1.5) as remote:
        running = simulate(remote, env=Slow())
        remote.reset(seed=1)
        *_, truncated, info = remote.step(1)
        assert not truncated
        assert info == {}
    running.join()


AGENT = """
import numpy as np
from rotorgram.udp import RemoteEnv
env = RemoteEnv(("127.0.0.1", 0), connect=False, timeout=1.5)
print(env.address[1], flush=True)
env.reset(seed=0)
print("flying", flush=True)
lost = 0
for i in range(60):
    *_, truncated, info = env.step(np.zeros(1))
    lost += "simulator_lost" in info
    if truncated:
        env.reset()
env.close()
print(lost)
"""
SIMULATOR = """
import sys, time
import gymnasium as gym
import numpy as np
from rotorgram.udp import Simulator

class Slow(gym.Env):
    observation_space = action_space = gym.spaces.Box(-9.0, 9.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        time.sleep(0.02)
        return np.zeros(1, np.float32), 0.0, False, False, {}

with Simulator(Slow(), server=("127.0.0.1", int(sys.argv[1])), bind=("127.0.0.1", 0)) as simulator:
    print(simulator.run())
"""


def test_sides_that_were_stopped_for_a_while_end_no_episode() -> None:  # fault 25
    agent = launch(AGENT)
    assert agent.stdout is not None
    simulator = launch(SIMULATOR, int(agent.stdout.readline()))
    agent.stdout.readline()
    simulator.send_signal(signal.SIGSTOP)
    time.sleep(0.1)  # the agent waits, and nothing comes
    agent.send_signal(signal.SIGSTOP)
    time.sleep(2.5)
    agent.send_signal(signal.SIGCONT)
    time.sleep(0.2)
    simulator.send_signal(signal.SIGCONT)
    assert agent.communicate(timeout=20) == ("0\n", "")
    assert simulator.communicate(timeout=20) == ("the agent closed\n", "")


def test_a_forked_child_does_not_close_its_parents_flight() -> None:  # fault 34
    with flying() as pair:
        pair.remote.reset(seed=1)
        child = os.fork()
        if not child:
            status = 1
            try:
                pair.remote.close()
                status = 0
            finally:
                os._exit(status)
        assert os.waitpid(child, 0)[1] == 0
        infos = [pair.remote.step(np.zeros(1))[-1] for _ in range(3)]
        assert not any("simulator_lost" in info for info in infos)
        assert pair.simulator.link.sequence == 5, "States: the first, the reset's and three"


def test_an_agent_that_flies_on_after_the_end() -> None:
    with flying(episode_length=1) as pair:
        pair.remote.reset(seed=1)
        pair.remote.step(np.zeros(1))
        pair.remote._flying = True  # an agent that does not keep to the rules
        with pytest.raises(PeerClosed, match="expected a reset"):
            pair.remote.step(np.zeros(1))
        assert isinstance(pair.running.join(), LinkError)


def test_an_env_that_the_papers_vehicle_cannot_fly(tmp_path: Path) -> None:
    """Binary never needs that vehicle, and a line of text from a stranger changes nothing."""
    vehicle = tmp_path / "slow.xml"
    vehicle.write_text(re.sub('timestep="[^"]*"', 'timestep="0.005"', QUAD_XML.read_text("utf-8")))
    options = {"control_period": 0.015}
    with (
        RemoteEnv(ANY, env_id=ENV_ID, options=options, connect=False, connect_timeout=5) as remote,
        plain_socket() as stranger,
    ):
        stranger.sendto(b"1", remote.address)
        running = simulate(remote, vehicle=vehicle, **options)
        remote.reset(seed=1)
        assert remote.control_period == 0.015
    assert running.join() == "the agent closed"


def test_an_agent_that_asks_for_an_env_needs_no_mujoco(tmp_path: Path) -> None:
    code = """
        import sys
        sys.modules["mujoco"] = None
        from rotorgram.udp import RemoteEnv
        wanted = {"env_id": "rotorgram/Elevation-v0", "options": {}, "record": sys.argv[1]}
        with RemoteEnv(("127.0.0.1", 0), connect=False, connect_timeout=10, **wanted) as env:
            print(env.address[1], flush=True)
            print(env.reset(seed=1)[0].shape)
    """
    agent = launch(code, tmp_path / "j")
    assert agent.stdout is not None
    server = "127.0.0.1", int(agent.stdout.readline())
    running = simulate(server)
    out, err = agent.communicate(timeout=60)
    assert out == "(3,)\n"
    assert err == ""
    assert running.join() == "the agent closed"


def test_text_needs_an_env_that_is_known_here() -> None:
    with RemoteEnv(ANY, connect=False, connect_timeout=0.5) as remote:
        running = simulate(remote, codec="text")
        with pytest.raises(ConnectionError):
            remote.connect()
        running.simulator.stop()
        running.join()


def test_a_world_of_two_drones_is_more_than_one_drone() -> None:
    two = replace(env_spec(EnvConfig(env_id=ENV_ID)), agents=("first", "second"))
    hello = Hello(session=1, spec=two.to_json())
    assert AgentConfig(drones=1).accept(hello) == "drones: expected a simulator of 1, got one of 2"
    layout = AgentConfig(drones=2).accept(hello)
    assert not isinstance(layout, str)
    assert layout.drones == 2


def test_the_advice_for_text_names_no_key() -> None:  # fault 57
    with pytest.raises(InputError) as caught:
        Simulator(server=("192.0.2.1", 8001), bind=ANY, codec="text")
    assert str(caught.value) == (
        "192.0.2.1 is not a loopback address: expected 127.0.0.1, or the binary codec and a key, "
        "or insecure=True (--insecure) where everybody who reaches this port may fly the drone: "
        "text cannot be sealed"
    )


def test_a_task_of_the_running_program_is_in_no_module() -> None:
    """Fault 61: the simulator's process cannot import it."""
    register("own-v0", type("Own", (Hover,), {"__module__": "__main__"}))
    try:
        with (
            pytest.raises(InputError, match=r"^env: expected a task of a module, .*got own-v0"),
            spawn_simulator(EnvConfig(env_id="own-v0")),
        ):
            pass
    finally:
        gym.registry.pop("own-v0")
