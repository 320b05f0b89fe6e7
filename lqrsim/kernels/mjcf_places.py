"""The centres of a robot's balls in MuJoCo: points fixed to bodies of an MJCF. Written in the kernels' subset.

`data` has the address that `mjcf_dynamics.py` calls p, the number of balls, the number of states that they depend on,
and for each ball the number of its body and its position in the body's axes. The code uses functions of that module.
"""

from lqrsim.kernels.declarations import N, at, call, stack, store
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
        body = int(data[3 + 4 * k])
        for i in range(3):
            place = origins[3 * body + i]
            for j in range(3):
                place += axes[9 * body + 3 * i + j] * data[4 + 4 * k + j]
            out[3 * k + i] = place
    store(p[FLAGS], slot, 0)


def places_jacobian(x, data, out, slopes):
    """Write the coordinates, and their derivatives in the states, which are zero on entry."""
    z, count = stack(N), 3 * int(data[1])
    for i in range(N):
        z[i] = x[i]
    for j in range(int(data[2])):
        h = 6e-6 * max(1.0, abs(x[j]))
        z[j] = x[j] + h
        places(z, data, out)
        for i in range(count):
            slopes[i, j] = out[i]
        z[j] = x[j] - h
        places(z, data, out)
        for i in range(count):
            slopes[i, j] = (slopes[i, j] - out[i]) / (2 * h)
        z[j] = x[j]
    places(x, data, out)
