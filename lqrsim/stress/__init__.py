"""Stress tests: how often a policy fails, under what, and how sure that is."""
