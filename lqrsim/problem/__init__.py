"""The user's problem: dynamics, costs, constraints, and the problem made of them."""
