"""The commands of `lqrsim`, each a class: its docstring and its fields' are the help text, `run` carries it out.

Heavy modules are imported inside `run`, so that `--help` answers at once.
"""
