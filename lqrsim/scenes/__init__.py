"""Scenes: files in MJCF and URDF, their kinematics and contacts, and the obstacles in them."""
