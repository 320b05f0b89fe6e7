"""All that is compiled, in the numba subset of Python; read `interface.py` first."""
