"""A stranger floods the agent's port with garbage at full speed while an agent trains.

    python studies/flood.py [--seconds 30] [--env-steps 200000] [--out FILE.json]

The garbage: random bytes, with a valid magic and without, Hellos of an env that is not flown and of
the one that is, States of sessions that do not exist, lines of text. The training has to end with
the very weights, optimizer's state and episodes of one that nobody disturbs.

It takes about two minutes on two cores.
"""

import json
import select
import subprocess
import sys
import time
from dataclasses import asdict
from typing import Any

from measuring import RESULTS, options, write
from rotorgram.agents import preset
from rotorgram.training.settings import Run
from rotorgram.training.training import Training
from rotorgram.udp.spawn import spawn_simulator

FLOOD = """
import json, random, socket, sys, time
import numpy as np
from dataclasses import replace
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.udp.layouts import layout_of
from rotorgram.udp.protocol import binary
from rotorgram.udp.protocol.messages import Hello, State
port, seconds = int(sys.argv[1]), float(sys.argv[2])
dice = random.Random(0)
spec = env_spec(EnvConfig())
layout, other = layout_of(spec), replace(spec, env_id="other/Env-v0")

def state():
    zero = np.zeros(1)
    return State(session=dice.getrandbits(64), sequence=1, time=0.0, rewards=zero,
                 terminated=zero > 0, truncated=zero > 0,
                 observations=tuple(np.zeros(s.shape, s.dtype) for s in layout.observation_slots),
                 telemetry=tuple(np.zeros(s.shape) for s in layout.telemetry_slots))

def hello(spec):
    return Hello(session=dice.getrandbits(64), spec=spec.to_json())

kinds = []
for _ in range(200):
    kinds += [
        dice.randbytes(dice.randrange(1400)),
        b"\\xa7R\\x02\\x05" + dice.randbytes(60),
        binary.encode(state(), layout),
        binary.encode(hello(other)),
        binary.encode(hello(spec)),
        b"1,0.5,0,0,1,2,3" + b",0" * 14,
    ]
sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
sock.connect(("127.0.0.1", port))
print("begins", flush=True)
until, sent = time.monotonic() + seconds, 0
while time.monotonic() < until:
    for datagram in kinds:
        try:
            sock.send(datagram)
            sent += 1
        except OSError:
            pass
print(json.dumps({"sent": sent, "datagrams_per_second": round(sent / seconds)}))
"""


def train(run: Run, flood_seconds: float) -> dict[str, Any]:
    with spawn_simulator(run.env, num_envs=1) as env:
        training = Training(run, env)
        flood = None
        marks = []

        def on_update() -> bool:
            nonlocal flood
            now = time.monotonic()
            if flood_seconds and flood is None and training.log.env_steps >= run.env_steps // 10:
                flood = subprocess.Popen(
                    [sys.executable, "-c", FLOOD, str(env.address[1]), str(flood_seconds)],
                    stdout=subprocess.PIPE,
                )
            # Its first line comes with its first datagram.
            if flood and not marks and not select.select([flood.stdout], [], [], 0)[0]:
                return True
            if flood and flood.poll() is None:
                marks.append((now, training.log.env_steps))
            return True

        training.train(on_update)
        said = json.loads(flood.communicate()[0].splitlines()[-1]) if flood else {}
        result = {
            "state": training.agent.state(),
            "episodes": [
                {k: v for k, v in asdict(e).items() if k != "seconds"}
                for e in training.log.episodes
            ],
            "steps_per_second": training.log.env_steps / training.log.seconds,
            "flood": said,
            "agent": env.statistics.numbers(),
        }
    if len(marks) > 1:
        began, first = marks[0]
        ended, last = marks[-1]
        result["flooded_seconds"] = round(ended - began, 1)
        result["flooded_steps_per_second"] = round((last - first) / (ended - began))
    return result


def main() -> None:
    out = RESULTS / "reliability" / "flood.json"
    args = options(__doc__, seconds=30.0, env_steps=200_000, out=out).parse_args()
    run = Run(
        algorithm="a2c",
        config=preset("a2c", "tuned"),
        seed=0,
        env_steps=args.env_steps,
    )
    calm = train(run, 0)
    flooded = train(run, args.seconds)
    same = calm["episodes"] == flooded["episodes"] and all(
        calm["state"][name].tobytes() == flooded["state"][name].tobytes() for name in calm["state"]
    )
    result = {
        "env_steps": args.env_steps,
        "episodes": len(calm["episodes"]),
        "identical": same,
        "steps_per_second": {
            "calm": round(calm["steps_per_second"]),
            "during the flood": flooded.get("flooded_steps_per_second"),
        },
        "flooded_seconds": flooded.get("flooded_seconds"),
        "flood": flooded["flood"],
        "agent": flooded["agent"],
    }
    write(args.out, result)
    print(json.dumps(result, indent=2))
    if not same:
        sys.exit(1)


if __name__ == "__main__":
    main()
