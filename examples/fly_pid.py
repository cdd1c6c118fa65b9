"""The two sides of the wire: a simulator in a process of its own, and here its agent, a PID.

python examples/fly_pid.py
"""

import subprocess
import sys

from rotorgram.agents import PID
from rotorgram.udp import RemoteEnv

# The agent is the UDP server: it listens first, on a free port. It refuses another target.
env = RemoteEnv(("127.0.0.1", 0), options={"target": 6.0}, connect=False)
host, port = env.address

# The simulator is the UDP client. It may as well run in another terminal, or on another machine.
simulator = subprocess.Popen(
    [sys.executable, "-m", "rotorgram.cli", "sim", "--server", f"{host}:{port}",
     "--bind", "127.0.0.1:0", "--env.target", "6.0"]
)  # fmt: skip
env.connect()  # the simulator's Hello brings the spec

pid = PID(env.env_spec)
observation, info = env.reset(seed=1)
pid.reset()
total = 0.0
terminated = False
truncated = False
while not (terminated or truncated):
    observation, reward, terminated, truncated, info = env.step(pid.act(observation))
    total += reward
print(f"return {total:.1f}, elevation {info['z']:.3f} m of {info['goal_z']} m")
print(env.statistics)
env.close()  # tells the simulator, which ends
simulator.wait()
