"""The protocol, free of sockets, clocks and simulators. Imports the standard library and NumPy."""
