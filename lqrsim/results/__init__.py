"""Results: solutions, policies, value functions, rollouts, and their files. NumPy only."""
