"""All that is compiled, in the numba subset of Python; read `declarations.py` first."""
