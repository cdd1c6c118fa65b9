"""Order, names and colours of agents in all tables and figures."""

from ..agents import ALGORITHMS, CONTROLLERS, is_controller

# Okabe and Ito's palette: told apart by readers with colour-blindness.
FLIGHT_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C564B")
"""Colours of flights and rotors on a light ground, the same palette."""
_SPARE = FLIGHT_COLORS[3:]


def agent_label(agent: str) -> str:
    """The name under which an agent is shown."""
    if agent in CONTROLLERS:
        return CONTROLLERS[agent].__name__
    known = ALGORITHMS.get(agent)
    return known.label if known else agent.rpartition(":")[2]


def agent_color(agent: str) -> str:
    """An agent's colour, the same in every figure and report."""
    if is_controller(agent):
        return "#555555"
    known = ALGORITHMS.get(agent)
    if known and known.color:
        return known.color
    return _SPARE[sum(agent.encode()) % len(_SPARE)]
