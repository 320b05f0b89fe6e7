"""Parking problems drawn at random, of which it is known beforehand whether there is a plan."""
