"""Drones in remote simulators as Gymnasium envs of the agent."""
