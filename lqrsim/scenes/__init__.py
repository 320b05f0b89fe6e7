"""From MJCF to the obstacles that the planner sees."""
