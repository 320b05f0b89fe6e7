"""The compiled code, in the subset of Python that `codegen/language.py` defines. Read `declarations.py` first."""
