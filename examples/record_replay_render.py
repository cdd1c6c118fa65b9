"""Record a flight over UDP, fly it again and compare every bit, and make a film of it.

    python examples/record_replay_render.py [FOLDER]

The same from the command line: rotorgram evaluate pid --episodes 1 --record flight.mcap
rotorgram replay flight.mcap --verify; rotorgram render flight.mcap --out flight.mp4
"""

import sys
from pathlib import Path

from rotorgram.agents.pid import PID
from rotorgram.envs import ElevationConfig
from rotorgram.experiments.evaluate import fly
from rotorgram.experiments.filming import Film, Shot, film
from rotorgram.experiments.flights import recorded_tracks
from rotorgram.experiments.pairs import socket_pair
from rotorgram.udp.replay import verify

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
journal, task = folder / "flight.mcap", ElevationConfig()
if journal.exists():
    sys.exit(f"{journal} is there already: name another folder")

with socket_pair(task, record=journal) as env:
    flight = fly(env, PID(task), seed=7)
print(f"return {flight.rewards.sum():.1f}: {journal}")

print(verify(journal))

# Looking needs OpenGL; flying and comparing do not.
shot = Shot(name="PID", color="#E69F00", tracks=recorded_tracks(journal, [0]))
film(folder / "flight.mp4", [shot], Film(width=640, height=360, camera="side", fast=True))
print(f"film: {folder / 'flight.mp4'}")
