"""A stress test as a page."""
