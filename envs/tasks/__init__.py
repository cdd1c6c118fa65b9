"""Tasks: start, observation, reward, end and metrics of an episode."""
