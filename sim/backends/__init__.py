"""Backends: physics engines that step worlds."""
