"""The physical examination of a vehicle, and the accuracy of its integrator."""

from ._measure import Check
from .examination import examine

__all__ = ["Check", "examine"]
