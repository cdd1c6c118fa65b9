"""Every controller: an agent that needs no training, made of an env's spec."""

from .geometric import Geometric
from .orca import Orca
from .pid import PID

Controller = type[PID] | type[Geometric] | type[Orca]
CONTROLLERS: dict[str, Controller] = {
    "pid": PID,
    "geometric": Geometric,
    "orca": Orca,
}
