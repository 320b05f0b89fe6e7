"""Whole problems, drawn at random, and what is true of their solutions by the problem alone."""
