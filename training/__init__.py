"""Many trainings: runs, comparisons, sweeps, benchmarks, their tables, figures and reports."""
