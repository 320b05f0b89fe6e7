"""What is compiled, in the subset of Python that `codegen/language.py` defines; read `declarations.py` first."""
