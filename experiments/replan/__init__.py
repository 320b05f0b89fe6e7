"""The questions that `benchmark_replanning.py` asks."""
