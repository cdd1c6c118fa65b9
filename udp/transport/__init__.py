"""The protocol on sockets: the simulator, the agent's port, and a relay that loses datagrams."""
