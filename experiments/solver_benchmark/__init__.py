"""The parts of benchmark_solver.py: each section measures, and writes its table."""
