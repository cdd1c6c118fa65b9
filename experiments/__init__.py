"""Training runs, evaluation, and the comparison with its figures and report."""
