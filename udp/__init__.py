"""The wire: simulators (UDP clients) and an agent (UDP server) in lock-step."""
