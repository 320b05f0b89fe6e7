"""The files that `lqrsim new` writes, for a robot named my_robot: programs that run unchanged."""
