"""What the processes that `benchmark_compiling.py` starts do: none of it is imported before their clock runs."""
