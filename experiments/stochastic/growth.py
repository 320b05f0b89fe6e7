"""What plans become as noise grows: clearance, and how hard the controls are used."""

from typing import Any

import numpy as np
from runner import table

import lqrsim as ls
from stochastic.common import Config, clearance, drive, gusts, jolts, quadrotor, rotors, slip

KINDS = {
    "drive, wheels off by a share of their speed": (drive, slip, (0.1, 0.3, 1.0)),
    "drive, displaced by so many m": (drive, jolts, (0.004, 0.016, 0.032)),
    "quadrotor, rotors off by a share of their force": (quadrotor, rotors, (0.1, 0.3, 1.0)),
    "quadrotor, gusts of so many m/s": (quadrotor, gusts, (0.02, 0.04, 0.08)),
}


def measure(config: Config) -> dict[str, Any]:
    rows = []
    for kind, (stated, noise, strengths) in KINDS.items():
        for strength in (0.0, strengths[-1]):
            solution = ls.smooth(stated().driven_by(noise(strength) if strength else None, None))
            used = solution.trajectory.controls
            rows.append({
                "kind": kind, "strength": strength, "clearance": clearance(solution),
                "used": float(np.sqrt(np.mean(used**2))), "gain": float(np.abs(solution.policy.gain).mean()),
            })  # fmt: skip
    return {"rows": rows}


def report(found: dict[str, Any]) -> list[str]:
    rows = [
        [f"{row['kind']}: {row['strength']:g}", f"{row['clearance']:.3f}", f"{row['used']:.3f}", f"{row['gain']:.3f}"]
        for row in found["rows"]
    ]
    return [
        "Noise that is always the same changes no plan, only what it is expected to cost. Noise that grows with the"
        " controls makes them smaller; whether the plan then keeps farther from obstacles depends on where it goes.",
        table(("noise", "clearance, m", "controls, rms", "mean gain"), rows),
    ]
