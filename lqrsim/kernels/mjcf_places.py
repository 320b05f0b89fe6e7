"""The centres of a robot's balls in MuJoCo: points fixed to bodies of an MJCF.

`data` has the address that `mjcf_dynamics.py` calls p, the number of balls, and for each ball the number of its body
and its place in the body's axes. It goes with functions of that module; `differences.py` has the derivatives.
"""

from lqrsim.kernels.declarations import at, call, store
from lqrsim.kernels.mjcf_dynamics import (
    DATA,
    FLAGS,
    KINEMATICS,
    MODEL,
    QPOS,
    SLOT,
    SLOTS,
    XMAT,
    XPOS,
    take_slot,
    write_positions,
)


def places(x, data, out):
    """Write the coordinates, ball by ball."""
    p = at(data[0])
    slot = take_slot(p)
    one = at(p[SLOTS] + 8 * SLOT * slot)
    write_positions(x, p, at(one[QPOS]))
    call(p[KINEMATICS], at(p[MODEL]), at(one[DATA]))
    origins, axes = at(one[XPOS]), at(one[XMAT])
    for k in range(int(data[1])):
        body = int(data[2 + 4 * k])
        for i in range(3):
            place = origins[3 * body + i]
            for j in range(3):
                place += axes[9 * body + 3 * i + j] * data[3 + 4 * k + j]
            out[3 * k + i] = place
    store(p[FLAGS], slot, 0)
