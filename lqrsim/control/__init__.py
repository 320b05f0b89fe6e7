"""Controllers, which run on a robot."""
