"""Stress tests: how often a policy fails, under which disturbances, how certain that is; and plans that fail less.

Names are imported when they are first used; `__init__.pyi` lists them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
