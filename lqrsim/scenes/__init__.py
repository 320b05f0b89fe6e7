"""Scenes: MJCF and URDF files, what MuJoCo computes of them (kinematics, statics, contacts), and their obstacles."""
