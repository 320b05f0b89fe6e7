"""What the arguments of `subjects.py` are made of: a small problem, its solution, a run of it."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

import lqrsim as ls

TINY = """
import dataclasses
import lqrsim as ls

def tiny():
    scenario = ls.scenarios.differential_drive()
    drive = scenario.problem
    end = ls.QuadraticCost(drive.final_cost.weight, about=(0.0, -2.4, 3.1))
    return dataclasses.replace(scenario, problem=dataclasses.replace(drive, steps=4, final_cost=end), paper_start=None)
"""


class Place:
    """What the subjects are made of."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "tiny.py").write_text(TINY, encoding="utf-8")
        namespace: dict[str, Any] = {}
        exec(TINY, namespace)
        self.scenario: ls.Scenario = namespace["tiny"]()
        self.problem = self.scenario.problem
        self.plant = self.scenario.plant()
        self.solution = ls.smooth(self.problem, starts=1)
        self.rollout = ls.simulate(self.plant, self.solution, disturbances=[ls.disturbances.ControlNoise(0.01)])
        self.space = self.problem.dynamics.state_coordinates
        self.controls = self.problem.dynamics.control_coordinates
        # Of one kind with the packaged scenario's, so that nothing else is compiled.
        self.second = dataclasses.replace(
            self.problem, initial=ls.FixedState((0.0, -2.5, np.pi)), control_limits=(-0.4, 0.4)
        )
