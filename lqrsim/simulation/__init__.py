"""Simulation in MuJoCo: plants, disturbances, and the closed loop with a controller."""
