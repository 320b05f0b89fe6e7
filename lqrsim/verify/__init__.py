"""Tracking verified from pixels: where the robot is in pictures, against what the record of the run says."""
