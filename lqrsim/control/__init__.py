"""Controllers that run on a robot."""
