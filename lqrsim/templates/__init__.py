"""What `lqrsim new` writes, as it is for a robot of the name my_robot: programs that run where they are."""
