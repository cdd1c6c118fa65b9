"""Bytes of flight stacks, one module for each: no socket and no clock."""
