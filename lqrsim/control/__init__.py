"""What runs on a robot: controllers."""
