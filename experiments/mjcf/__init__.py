"""Robots of MJCFs that others wrote: what they are to do, and how they are solved."""
