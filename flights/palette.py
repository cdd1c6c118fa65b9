"""Order, names and colours of agents in all tables and figures."""

from typing import Final

from ..agents import ALGORITHMS, CONTROLLERS

# Okabe and Ito's palette: told apart by readers with colour-blindness. The second of a pair is the
# same hue, lighter, for a dark ground.
_CONTROLLERS: Final = ("#555555", "#B4BCC4")
_SPARE: Final = (
    ("#CC79A7", "#E29AC3"),
    ("#E69F00", "#F0B840"),
    ("#56B4E9", "#7CC8F2"),
    ("#8C564B", "#C9938A"),
)
FLIGHT_COLORS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C564B")
"""Colours of flights and rotors on a light ground, the same palette."""
_OWN: Final = {name: row.colors for name, row in ALGORITHMS.items() if row.colors} | dict.fromkeys(
    CONTROLLERS, _CONTROLLERS
)
DARK_COLORS: Final = [dark for _, dark in (*_OWN.values(), *_SPARE)]


def agent_label(agent: str) -> str:
    """The name under which an agent is shown."""
    row = ALGORITHMS.get(agent) or CONTROLLERS.get(agent)
    return row.label if row else agent


def agent_color(agent: str, dark: bool = False) -> str:
    """An agent's colour, the same in every figure and report; lighter for a dark ground."""
    spare = _SPARE[sum(agent.encode()) % len(_SPARE)]
    return _OWN.get(agent, spare)[dark]
