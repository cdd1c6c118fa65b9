"""Every controller: an agent that needs no training, made of an env's spec."""

from .geometric import Geometric
from .orca import Orca
from .pid import PID
from .vfh import Vfh

Controller = type[PID] | type[Geometric] | type[Orca] | type[Vfh]
CONTROLLERS: dict[str, Controller] = {
    "pid": PID,
    "geometric": Geometric,
    "orca": Orca,
    "vfh": Vfh,
}
