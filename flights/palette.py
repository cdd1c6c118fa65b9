"""Order, names and colours of agents in all tables and figures."""

from collections.abc import Iterable
from typing import Final

_LABELS: Final = {
    "vpg": "VPG", "a2c": "A2C", "ppo": "PPO", "ippo": "IPPO", "mappo": "MAPPO", "sac": "SAC",
    "sb3-a2c": "SB3 A2C", "sb3-ppo": "SB3 PPO", "sb3-sac": "SB3 SAC", "pid": "PID",
    "geometric": "Geometric", "orca": "ORCA",
}  # fmt: skip
# Okabe and Ito's palette: told apart by readers with colour-blindness. The second of a pair is the
# same hue, lighter, for a dark ground.
_COLORS: Final = {
    "vpg": ("#D55E00", "#F58A3C"),
    "a2c": ("#0072B2", "#55B0F0"),
    "sb3-a2c": ("#009E73", "#2CC998"),
    "pid": ("#555555", "#B4BCC4"),
    "geometric": ("#555555", "#B4BCC4"),
    "orca": ("#555555", "#B4BCC4"),
}
_SPARE: Final = (
    ("#CC79A7", "#E29AC3"),
    ("#E69F00", "#F0B840"),
    ("#56B4E9", "#7CC8F2"),
    ("#8C564B", "#C9938A"),
)
FLIGHT_COLORS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C564B")
"""Colours of flights and rotors on a light ground, the same palette."""
DARK_COLORS: Final = [dark for _, dark in (*_COLORS.values(), *_SPARE)]


def agent_label(agent: str) -> str:
    """Give the name under which an agent is shown."""
    return _LABELS.get(agent, agent)


def agent_color(agent: str, dark: bool = False) -> str:
    """Give an agent's colour, the same in every figure and report; lighter for a dark ground."""
    spare = _SPARE[sum(agent.encode()) % len(_SPARE)]
    return _COLORS.get(agent, spare)[dark]


def sort_agents(names: Iterable[str]) -> list[str]:
    """Put agents in the order in which they are shown: the paper's, the reference, others."""
    known = {name: place for place, name in enumerate(_LABELS)}
    return sorted(set(names), key=lambda name: (known.get(name, len(known)), name))
