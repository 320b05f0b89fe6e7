"""The controller for a Crazyflie in `docs/microcontrollers.md`, compiled with stand-ins for the firmware's headers."""

import ctypes
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sampling import examples
from scipy.spatial.transform import Rotation

import lqrsim as ls
from lqrsim.errors import Array

THRUST_MAX, LEGACY, FORCE = 0.12, 0, 2
# What the controller takes from each header, with the firmware's names, order and units.
HEADERS = {
    "FreeRTOS.h": "#define M2T(ms) (ms)",
    "app.h": "void appMain(void);",
    "task.h": "void vTaskDelay(int ticks);",
    "platform_defaults.h": f"#define THRUST_MAX {THRUST_MAX}f",
    "param.h": """
#define PARAM_UINT8 0
#define PARAM_GROUP_START(NAME) extern int group_##NAME;
#define PARAM_ADD(TYPE, NAME, ADDRESS) unsigned char *parameter_##NAME = ADDRESS;
#define PARAM_GROUP_STOP(NAME)
""",
    "controller.h": """
#pragma once
#include <stdbool.h>
#include <stdint.h>
#define STABILIZER_NR_OF_MOTORS 4
typedef uint32_t stabilizerStep_t;
typedef struct { float x, y, z, w; } quaternion_t;
typedef struct { float x, y, z; } vector_t;
typedef struct { vector_t gyro; } sensorData_t;
typedef struct { quaternion_t attitudeQuaternion; vector_t position, velocity; } state_t;
typedef enum { modeDisable = 0, modeAbs, modeVelocity } stab_mode_t;
typedef struct { struct { stab_mode_t x, y, z; } mode; } setpoint_t;
typedef struct {
    union { struct { int16_t roll, pitch, yaw; float thrust; }; float normalizedForces[STABILIZER_NR_OF_MOTORS]; };
    enum { controlModeLegacy = 0, controlModeForceTorque = 1, controlModeForce = 2 } controlMode;
} control_t;
void controllerOutOfTreeInit(void);
bool controllerOutOfTreeTest(void);
void controllerOutOfTree(control_t *, const setpoint_t *, const sensorData_t *, const state_t *, stabilizerStep_t);
""",
    "controller_pid.h": """
#include "controller.h"
void controllerPidInit(void);
bool controllerPidTest(void);
void controllerPid(control_t *, const setpoint_t *, const sensorData_t *, const state_t *, stabilizerStep_t);
""",
}
# The firmware's loop: one step of it, and a PID controller that leaves roll, pitch and yaw as they are, as it does in
# every other step.
LOOP = """
#include <string.h>
#include "controller_pid.h"

void vTaskDelay(int ticks) { (void)ticks; }
void controllerPidInit(void) {}
bool controllerPidTest(void) { return true; }
void controllerPid(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors, const state_t *state,
                   stabilizerStep_t step)
{
    (void)setpoint, (void)sensors, (void)state, (void)step;
    control->controlMode = controlModeLegacy;
    control->thrust = 7.0f;
}

static control_t control;

int loop(const float *shown, int mode_x, int mode_z, unsigned step, float *forces)
{
    const setpoint_t setpoint = {{(stab_mode_t)mode_x, modeAbs, (stab_mode_t)mode_z}};
    const state_t state = {
        {shown[6], shown[7], shown[8], shown[9]}, {shown[0], shown[1], shown[2]}, {shown[3], shown[4], shown[5]},
    };
    const sensorData_t sensors = {{shown[10], shown[11], shown[12]}};
    controllerOutOfTree(&control, &setpoint, &sensors, &state, step);
    memcpy(forces, control.normalizedForces, sizeof control.normalizedForces);
    return control.controlMode;
}

int untouched(void) { return control.roll == 0 && control.pitch == 0 && control.yaw == 0; }
"""


class Firmware:
    """The page's controller in the stabilizer loop, with a law."""

    def __init__(self, law: ls.AffinePolicy, folder: Path) -> None:
        ls.export_c(law, folder)
        page = (Path(__file__).parent.parent / "docs" / "microcontrollers.md").read_text(encoding="utf-8")
        _, section = page.split("## On a Crazyflie\n")
        (code,) = re.findall(r"^```c\n(.*?)^```$", section.split("\n## ")[0], re.MULTILINE | re.DOTALL)
        for name, text in {**HEADERS, "controller.c": code, "loop.c": LOOP}.items():
            (folder / name).write_text(text, encoding="utf-8")
        warnings = ("-std=gnu11", "-Wall", "-Wextra", "-Werror", "-Wdouble-promotion", "-fno-math-errno")
        sources = "controller.c", "loop.c", "policy.c"
        said = ["cc", *warnings, "-Os", "-shared", "-fPIC", "-o", "firmware.so", *sources, "-lm"]
        subprocess.run(said, cwd=folder, check=True)
        self._library = ctypes.CDLL(str(folder / "firmware.so"))
        self._run = ctypes.POINTER(ctypes.c_ubyte).in_dll(self._library, "parameter_run")
        self.untouched = self._library.untouched
        self._library.controllerOutOfTreeInit()

    @property
    def fits(self) -> bool:
        self._library.controllerOutOfTreeTest.restype = ctypes.c_bool
        return self._library.controllerOutOfTreeTest()

    @property
    def run(self) -> int:
        return self._run[0]

    @run.setter
    def run(self, value: int) -> None:
        self._run[0] = value

    def __call__(self, shown: Array, step: int, *, x: int = 1, z: int = 1) -> tuple[int, Array]:
        """The control mode and the rotors' forces in N after one step of the loop, with these modes of the setpoint."""
        numbers, forces = shown.astype(np.float32), np.zeros(4, dtype=np.float32)
        mode = self._library.loop(
            numbers.ctypes.data_as(ctypes.c_void_p), x, z, step, forces.ctypes.data_as(ctypes.c_void_p)
        )
        return mode, forces * THRUST_MAX


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler, cc")
@settings(max_examples=examples(8))
@given(seed=st.integers(0, 2**32 - 1), dt=st.sampled_from([0.01, 1 / 30]))
def test_the_crazyflie_flies_the_law_when_told_to(
    seed: int, dt: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """PID from power-on; the law of Python while `policy.run` is 1 and the setpoint is a position; then PID again."""
    rng, dynamics = np.random.default_rng(seed), ls.Quadrotor(max_force=THRUST_MAX).dynamics
    law = ls.AffinePolicy(
        gain=0.01 * rng.normal(size=(9, 4, 12)), offset=0.06 + 0.03 * rng.normal(size=(9, 4)),
        nominal=0.3 * rng.normal(size=(9, 12)), dt=dt, state_coordinates=dynamics.state_coordinates,
        control_coordinates=dynamics.control_coordinates,
    )  # fmt: skip
    firmware, first = Firmware(law, tmp_path_factory.mktemp("c")), int(rng.integers(1, 2**32 - 2000))
    assert firmware.fits

    def drawn() -> tuple[Array, Array]:
        """What the firmware knows, and the state of the law, whose rotation is less than half a turn off."""
        moving, turn = rng.normal(size=6), Rotation.from_rotvec(rng.uniform(-1, 1, 3))
        gyro, sign = rng.normal(size=3), rng.choice([-1.0, 1.0])  # q and -q are one rotation
        shown = np.concatenate([moving, sign * turn.as_quat(), np.degrees(gyro)])
        return shown, np.concatenate([moving, turn.as_rotvec(), gyro])

    assert firmware(drawn()[0], first - 1)[0] == LEGACY
    for begin in (first, first + 700):
        firmware.run = 1
        command = np.zeros(4)
        calls = set[int]()
        for step in range(400):
            (shown, state), period = drawn(), int(step * 1e-3 / dt + 1e-9)
            if period not in calls:
                command = law(state, step * 1e-3)
                calls.add(period)
            mode, forces = firmware(shown, begin + step)
            assert mode == FORCE
            # A float's rounding over a dozen products of numbers below 10 with gains of 0.01.
            np.testing.assert_allclose(forces, command, rtol=0, atol=1e-6)
        (shown, _), gone = drawn(), begin + 400
        if begin == first:
            x, z = ((0, 1), (1, 0), (0, 0), (2, 1))[rng.integers(4)]
            assert firmware(shown, gone, x=x, z=z)[0] == LEGACY
        else:
            shown[rng.integers(13)] = np.nan
            while firmware(shown, gone)[0] == FORCE:  # until the next control period
                gone += 1
            assert gone - begin - 400 < dt * 1e3 + 1
        assert firmware.untouched()
        assert firmware.run == 0
        assert firmware(drawn()[0], gone + 1)[0] == LEGACY
