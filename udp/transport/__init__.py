"""The protocol on sockets: the simulator, and the agent's port."""
