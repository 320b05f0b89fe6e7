"""Feedback policies by iterated LQR smoothing, executed under disturbances in MuJoCo and shown on video.

    import lqrsim as ls

    scenario = ls.scenarios.differential_drive()
    solution = ls.smooth(scenario.problem)
    rollout = ls.simulate(scenario.plant(), solution, disturbances=[ls.disturbances.ControlNoise(0.05)], seed=0)
    ls.render(rollout, "arena.mp4")

Names are imported when they are first used, so that importing lqrsim costs nothing; `__init__.pyi` lists them.
"""

import os
from typing import Any

import lazy_loader

_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("lqrsim")
    try:
        return _attribute(name)
    except Exception as error:
        if "MUJOCO_GL" not in os.environ or name not in __all__:
            raise
        from lqrsim.errors import check_opengl

        check_opengl(error)
        raise
