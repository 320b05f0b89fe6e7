"""What comes out: solutions, policies, value functions, rollouts, and their files. NumPy only."""
