"""Your own agent with nothing but a socket: the paper's text, one line each way for each step.

    python examples/text_agent.py [PORT]      and in another terminal
    rotorgram sim --codec text [--server 127.0.0.1:PORT]

The simulator sends `sequence,reward,terminated,truncated,E,rate,thrust,…`; the answer is
`sequence,action`, or `sequence,reset`, or `sequence,close`. It repeats what is not answered.
"""

import socket
import sys

agent = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
agent.bind(("127.0.0.1", int(sys.argv[1]) if len(sys.argv) > 1 else 8001))
episodes = 0
steps = 0
total = 0.0
last = ""
reply = b""
while not reply.endswith(b"close"):
    line, simulator = agent.recvfrom(1200)
    sequence, *fields = line.decode().split(",")
    if fields == ["close"]:
        break
    if sequence != last:  # a repeat gets the answer that it did not hear
        reward, terminated, truncated, error, rate, thrust = map(float, fields[:6])
        last = sequence
        steps += 1
        total += reward
        if terminated or truncated:
            print(f"episode {episodes}: {steps - 1} steps, return {total:.1f}", flush=True)
            episodes += 1
            steps = 0
            total = 0.0
            reply = f"{sequence},{'reset' if episodes < 3 else 'close'}".encode()
        else:
            action = 9 * error + 6 * rate - 9.8 * thrust  # here goes what you have learnt
            reply = f"{sequence},{max(-1.0, min(1.0, action))}".encode()
    agent.sendto(reply, simulator)
