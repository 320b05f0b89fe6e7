"""What a user states: dynamics, costs, constraints, and the problem made of them."""
