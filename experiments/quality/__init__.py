"""The parts of benchmark_quality.py: each measures, and writes its table."""
