"""Stress tests: how often a policy fails, under which disturbances, and with which confidence."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
