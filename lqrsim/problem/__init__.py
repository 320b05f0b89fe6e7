"""The user's problem: dynamics, costs, constraints, and the problem that they form."""
