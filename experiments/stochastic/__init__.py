"""Sections of `noise_aware.py`."""
