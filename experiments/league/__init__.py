"""A league of solvers: problems, contestants, and what their plans are worth."""
