"""Record a flight over UDP, fly it again and compare every bit, and make a film of it.

    python examples/record_replay_render.py [FOLDER]

The same from the command line: rotorgram evaluate pid --episodes 1 --record flight.mcap
rotorgram replay flight.mcap --verify; rotorgram render flight.mcap --out flight.mp4
"""

import sys
from pathlib import Path

from rotorgram.agents import PID
from rotorgram.envs import EnvConfig
from rotorgram.flights.filming import Film, FilmTrack, film
from rotorgram.flights.recorded import recorded_trajectories
from rotorgram.flights.trajectories import fly_episodes
from rotorgram.udp.journal.replay import Verification
from rotorgram.udp.spawn import spawn_simulator

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
journal = folder / "flight.mcap"
if journal.exists():
    sys.exit(f"{journal} is there already: name another folder")

with spawn_simulator(EnvConfig(), num_envs=1, record=journal) as env:
    (trajectory,) = fly_episodes(env, PID(env.env_spec), episodes=1)
print(f"return {trajectory.rewards.sum():.1f}: {journal}")

print(Verification(journal))

# A film needs OpenGL; flying and comparing do not.
track = FilmTrack(name="PID", trajectories=recorded_trajectories(journal, [0]))
film(folder / "flight.mp4", [track], Film(width=640, height=360, camera="side", fast=True))
print(f"film: {folder / 'flight.mp4'}")
