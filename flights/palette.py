"""Order, names and colours of agents in all tables and figures."""

from ..agents import ALGORITHMS, CONTROLLERS

# Okabe and Ito's palette: told apart by readers with colour-blindness.
_CONTROLLER = "#555555"
_SPARE = ("#CC79A7", "#E69F00", "#56B4E9", "#8C564B")
FLIGHT_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C564B")
"""Colours of flights and rotors on a light ground, the same palette."""
_OWN = {name: row.color for name, row in ALGORITHMS.items() if row.color} | dict.fromkeys(
    CONTROLLERS, _CONTROLLER
)


def agent_label(agent: str) -> str:
    """The name under which an agent is shown."""
    row = ALGORITHMS.get(agent) or CONTROLLERS.get(agent)
    return row.label if row else agent


def agent_color(agent: str) -> str:
    """An agent's colour, the same in every figure and report."""
    spare = _SPARE[sum(agent.encode()) % len(_SPARE)]
    return _OWN.get(agent, spare)
