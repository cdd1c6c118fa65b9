"""Bytes of flight stacks, one module for each: no socket, no clock, NumPy alone."""
