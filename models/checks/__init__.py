"""The physical examination of a vehicle, and the accuracy of its integrator."""

from .examination import Check, examine

__all__ = ["Check", "examine"]
