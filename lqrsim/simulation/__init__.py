"""Execution in MuJoCo: a plant, disturbances, and the closed loop of the two with a policy."""
