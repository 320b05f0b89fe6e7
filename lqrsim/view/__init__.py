"""Pictures of what was planned and what happened."""
