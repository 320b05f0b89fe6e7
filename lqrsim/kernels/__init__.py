"""All that is compiled, in a subset of Python that `codegen/language.py` writes down; read `declarations.py` first."""
