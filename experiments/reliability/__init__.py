"""Random problems of many kinds, and the parts of benchmark_reliability.py: each measures, and writes its table."""
