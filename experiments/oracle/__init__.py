"""An independent judge: a problem's dynamics, costs and constraints evaluated by its formulas alone, in plain NumPy."""
