"""Drones in simulators elsewhere, as Gymnasium envs of the agent's."""
