"""MuJoCo's own steps as dynamics: a control period by `mj_step` and its parts, called at their addresses.

States are tangent coordinates: a position for each degree of freedom, then the velocities, then the actuators' own
states. The rotation of a ball or free joint is three numbers, a rotation vector. `p` has the wrench on the body, then
addresses and sizes, at the indices named below; `scenes/mjcf_physics.py` writes it. Several threads may run these
functions at once. Each takes a slot, two `MjData` that it owns for as long as it needs them. If bodies carry loads, a
slot also has its own model.

A step and its helper functions are compiled separately. Functions that do arithmetic here are therefore `outline` and
`exact`. Otherwise LLVM would reorder sums depending on where they are inlined, and bits would depend on the thread.
"""

from math import atan2, cos, nan, pi, sqrt

from lqrsim.kernels.declarations import (
    M,
    N,
    W,
    at,
    call,
    claim,
    exact,
    fetch_add,
    int32,
    load,
    outline,
    rows_at,
    stack,
    store,
)
from lqrsim.kernels.rotation_ratios import sine_ratio

# The layout of p. WRENCH: force and torque on the body, world axes, 6 numbers. FLAGS, SLOTS, COUNT: flags of the slots
# in use, address of their numbers, number of slots. MODEL: MuJoCo's model. STEP, FORWARD, INTEGRATE: the addresses of
# mj_step, mj_forwardSkip and the integrator; the last is 0 if parts of a step cannot be called separately. TIMESTEP:
# timestep of the physics, in s. NV, NA: numbers of degrees of freedom and of actuators' states. JOINTS: number of
# joints; ACTUATORS: address of the list of actuators that the controls drive. TEAM, JOB: addresses at which helper
# threads find their work, 0 without helpers; YIELD: the address of the function that yields to other threads;
# KINEMATICS, RESET, COMPOS, JAC, DISTANCE: the addresses of mj_kinematics, mj_resetData, mj_comPos, mj_jac and
# mj_geomDistance; DISTANCE_MODEL: the model for distances. LOADED, LOADS: number of bodies that may carry a load, and
# address of the loads, in kg; the numbers of these bodies and their own masses follow. CONSTANTS: the address of
# mj_setConst. TABLE: the joints' kind and places in qpos and qvel, three numbers each.
WRENCH, FLAGS, SLOTS, COUNT, MODEL, STEP, FORWARD, INTEGRATE = 0, 6, 7, 8, 9, 10, 11, 12
TIMESTEP, NV, NA, JOINTS, ACTUATORS, TEAM, JOB, YIELD, KINEMATICS = 13, 14, 15, 16, 17, 18, 19, 20, 21
RESET, COMPOS, JAC, DISTANCE, DISTANCE_MODEL, LOADED, LOADS, CONSTANTS, TABLE = 22, 23, 24, 25, 26, 27, 28, 29, 30

# Addresses that a slot has for each of its two MjData.
SLOT, SIZE = 28, 14
DATA, QPOS, QVEL, ACT, CTRL, WARM, QACC, PUSH, XPOS, XMAT, GEOM_XPOS, GEOM_XMAT = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11
OWN_MODEL, MASSES = 12, 13

# The words that a team shares: whether it is in use, the next column, combined with the number of the job, the number
# of finished columns, whether to stop, the number of helpers, and whether a signal came, after which all steps are NaN.
BUSY, TICKET, DONE, STOP, HELPERS, SIGNALLED = 0, 1, 2, 3, 4, 5
JOBS = 65536  # the ticket is JOBS * job + column
PATIENT = 2000  # number of looks at the ticket before a helper lets other threads run

FREE, BALL = 0, 1  # MuJoCo's kinds of joints that have a rotation
LARGEST = 1e10  # MuJoCo's mjMAXVAL: larger numbers are no valid state


def advance(x, u, p, h, out):
    """Write the state after `h` seconds, (N,): a whole number of physics steps; NaN if it overflows."""
    z = stack(W)
    substeps = steps_in(x, u, p, h, z)
    if substeps < 1:
        for i in range(N):
            out[i] = nan
        return
    slot = take_slot(p)
    run(z, p, p, substeps, at(p[SLOTS] + 8 * SLOT * slot + 8 * SIZE), out)
    store(p[FLAGS], slot, 0)


def step_jacobian(x, u, p, h, out, jacobian):
    """Write the same step and its Jacobian `[A B]` (N, W), by central differences over the whole step.

    Free helpers also compute columns. The bits do not depend on which thread computed a column.
    """
    z = stack(W)
    substeps = steps_in(x, u, p, h, z)
    if substeps < 1:
        for i in range(N):
            out[i] = nan
            for j in range(W):
                jacobian[i, j] = nan
        return
    team, slot = p[TEAM], take_slot(p)
    together = team != 0 and load(team, HELPERS) > 0 and claim(team, BUSY) == 1
    if together:
        job = at(p[JOB])
        job[0] = substeps
        for i in range(W):
            job[1 + i] = z[i]
        for i in range(6):
            job[1 + W + i] = p[WRENCH + i]
        store(team, DONE, 0)
        store(team, TICKET, JOBS * (load(team, TICKET) // JOBS + 1))
    address, warm = p[SLOTS] + 8 * SLOT * slot, stack(N)
    run(z, p, p, substeps, at(address + 8 * SIZE), out)
    linearize_here(z, p, p, address, warm)
    if not together:
        for k in range(W):
            column(k, z, p, p, substeps, address, warm, jacobian)
        store(p[FLAGS], slot, 0)
        return
    columns = job_columns(p)
    k = fetch_add(team, TICKET, 1) % JOBS
    while k < W:
        column(k, z, p, p, substeps, address, warm, columns)
        fetch_add(team, DONE, 1)
        k = fetch_add(team, TICKET, 1) % JOBS
    patience = 0
    while load(team, DONE) < W:  # a helper still has work to do, once it gets to run
        patience += 1
        if patience > PATIENT and p[YIELD] != 0:
            call(p[YIELD])
    for i in range(N):
        for j in range(W):
            jacobian[i, j] = columns[i, j]
    store(team, BUSY, 0)
    store(p[FLAGS], slot, 0)


def help_out(p):
    """Compute columns for the threads that linearise, until told to stop.

    A thread takes a column first, and reads its job afterwards. Until the column is done, no other job is written.
    """
    team, slot, known, patience = p[TEAM], take_slot(p), -1, 0
    address, warm, job, columns = p[SLOTS] + 8 * SLOT * slot, stack(N), at(p[JOB]), job_columns(p)
    z, wrench = stack(W), stack(6)
    while load(team, STOP) == 0:
        if load(team, TICKET) % JOBS >= W:
            patience += 1
            if patience > PATIENT and p[YIELD] != 0:
                call(p[YIELD])
            continue
        patience, ticket = 0, fetch_add(team, TICKET, 1)
        if ticket % JOBS >= W:
            continue
        if ticket // JOBS != known:
            known = ticket // JOBS
            for i in range(W):
                z[i] = job[1 + i]
            for i in range(6):
                wrench[i] = job[1 + W + i]
            linearize_here(z, p, wrench, address, warm)
        column(ticket % JOBS, z, p, wrench, int(job[0]), address, warm, columns)
        fetch_add(team, DONE, 1)
    store(p[FLAGS], slot, 0)


def job_columns(p):
    """Destination of a job's columns: rows of W numbers."""
    return rows_at(p[JOB] + 8 * (1 + W + 6), W)


def run(z, p, wrench, substeps, two, out):
    """Write the state after this number of physics steps."""
    write_loads(p, two)
    write_to(z, p, two)
    begin(p, wrench, two)
    for _ in range(substeps):
        call(p[STEP], at(two[OWN_MODEL]), at(two[DATA]))
    read_from(z, p, two, out)


def linearize_here(z, p, wrench, address, warm):
    """Set the first MjData of a slot to the state that columns differ from, and write MuJoCo's accelerations there."""
    one = at(address)
    write_loads(p, one)
    write_to(z, p, one)
    begin(p, wrench, one)
    call(p[FORWARD], at(one[OWN_MODEL]), at(one[DATA]), int32(0), int32(1))
    accelerations = at(one[QACC])
    for i in range(int(p[NV])):
        warm[i] = accelerations[i]


@outline
@exact
def column(k, z, p, wrench, substeps, address, warm, jacobian):
    """Write the k-th column of the Jacobian. Controls come first: they do not change the stage of velocities.

    A perturbed velocity or control does not change the position stage of the first physics step, so that stage is
    reused. MuJoCo's solver starts at the solution of the unperturbed step. Both sides then end equally near to their
    solutions, so that the solver's tolerance is not divided by the difference.
    """
    one, two, nv = at(address), at(address + 8 * SIZE), int(p[NV])
    moved, ahead, behind = stack(W), stack(N), stack(N)
    for i in range(W):
        moved[i] = z[i]
    j = k + N if k < M else k - M
    difference = 1e-6 * max(1.0, abs(z[j]))
    kept = 0 if j < nv or p[INTEGRATE] == 0 else 1 if j < N else 2
    for side in range(2):
        moved[j] = z[j] + difference if side == 0 else z[j] - difference
        begin(p, wrench, two)
        if kept > 0:
            step_from(moved, p, one, two, warm, kept)
        else:
            write_to(moved, p, two)
            start_from(p, two, warm)
        for _ in range(substeps - 1 if kept > 0 else substeps):
            call(p[STEP], at(two[OWN_MODEL]), at(two[DATA]))
        read_from(z, p, two, ahead if side == 0 else behind)
    for i in range(N):
        jacobian[i, j] = (ahead[i] - behind[i]) / (2 * difference)


def steps_in(x, u, p, h, z):
    """The number of physics steps in `h` seconds; 0 if MuJoCo cannot step: backwards, or from NaN.

    Also 0 after a signal. Writes the state and the control, one after the other, (W,).
    """
    for i in range(W):
        z[i] = x[i] if i < N else u[i - N]
        if not abs(z[i]) < LARGEST:
            return 0
    if p[TEAM] != 0 and load(p[TEAM], SIGNALLED) != 0:
        return 0
    return int(h / p[TIMESTEP] + 0.5) if h > 0 else 0


def take_slot(p):
    """Claim a free slot."""
    slot, count = 0, int(p[COUNT])
    while claim(p[FLAGS], slot) == 0:
        slot = (slot + 1) % count
    return slot


def write_to(z, p, one):
    """Write a state and a control into an MjData."""
    nv = int(p[NV])
    qvel, act, ctrl = at(one[QVEL]), at(one[ACT]), at(one[CTRL])
    write_positions(z, p, at(one[QPOS]))
    for i in range(nv):
        qvel[i] = z[nv + i]
    for i in range(int(p[NA])):
        act[i] = z[2 * nv + i]
    listed = int(p[ACTUATORS])
    for i in range(M):
        ctrl[int(p[listed + i])] = z[N + i]


def write_positions(x, p, qpos):
    """Write MuJoCo's positions of a state."""
    for k in range(int(p[JOINTS])):
        kind, q, d = int(p[TABLE + 3 * k]), int(p[TABLE + 3 * k + 1]), int(p[TABLE + 3 * k + 2])
        if kind == FREE:
            for i in range(3):
                qpos[q + i] = x[d + i]
            write_quaternion(x, d + 3, qpos, q + 3)
        elif kind == BALL:
            write_quaternion(x, d, qpos, q)
        else:
            qpos[q] = x[d]


def begin(p, wrench, one):
    """Make the next step of an MjData independent of earlier steps, and apply the wrench to the body."""
    warm, push = at(one[WARM]), at(one[PUSH])
    for i in range(int(p[NV])):
        warm[i] = 0.0
    for i in range(6):
        push[i] = wrench[WRENCH + i]


def write_loads(p, one):
    """Add the loads to the bodies, at their centres of mass, in the model of the slot. Changes the MjData's positions.

    MuJoCo's constants follow the masses: inertias of bodies that float freely, and the inverse inertias by which the
    softness of contacts, limits, friction and equality constraints is scaled.
    """
    count, first, masses = int(p[LOADED]), int(p[LOADS]), at(one[MASSES])
    changed = False
    for k in range(count):
        body, mass = int(p[first + count + k]), p[first + 2 * count + k] + p[first + k]
        changed = changed or masses[body] != mass
        masses[body] = mass
    if changed:
        call(p[CONSTANTS], at(one[OWN_MODEL]), at(one[DATA]))


def start_from(p, one, guess):
    """Let the solver of the next step begin at these accelerations."""
    warm = at(one[WARM])
    for i in range(int(p[NV])):
        warm[i] = guess[i]


def step_from(z, p, one, two, guess, kept):
    """Write a physics step to `two`, reusing the stages of `one` that do not change."""
    write_to(z, p, one)
    start_from(p, one, guess)
    call(p[FORWARD], at(one[OWN_MODEL]), at(one[DATA]), int32(kept), int32(1))
    call(p[INTEGRATE], at(one[OWN_MODEL]), at(one[DATA]))
    nv = int(p[NV])
    write_to(z, p, two)
    for k in range(int(p[JOINTS])):
        kind, q = int(p[TABLE + 3 * k]), int(p[TABLE + 3 * k + 1])
        copy_between(one[QPOS], two[QPOS], q, 7 if kind == FREE else 4 if kind == BALL else 1)
    copy_between(one[QVEL], two[QVEL], 0, nv)
    copy_between(one[WARM], two[WARM], 0, nv)
    copy_between(one[ACT], two[ACT], 0, int(p[NA]))


def copy_between(source, target, first, count):
    """Copy numbers from one address to another."""
    there, here = at(source), at(target)
    for i in range(first, first + count):
        here[i] = there[i]


def read_from(near, p, one, out):
    """Write the state of an MjData, with the rotation vectors nearest to the vectors in `near`; NaN if invalid."""
    nv, na = int(p[NV]), int(p[NA])
    qpos, qvel, act = at(one[QPOS]), at(one[QVEL]), at(one[ACT])
    for k in range(int(p[JOINTS])):
        kind, q, d = int(p[TABLE + 3 * k]), int(p[TABLE + 3 * k + 1]), int(p[TABLE + 3 * k + 2])
        if kind == FREE:
            for i in range(3):
                out[d + i] = qpos[q + i]
            rotation_vector_near(qpos, q + 3, near, d + 3, out)
        elif kind == BALL:
            rotation_vector_near(qpos, q, near, d, out)
        else:
            out[d] = qpos[q]
    for i in range(nv):
        out[nv + i] = qvel[i]
    for i in range(na):
        out[2 * nv + i] = act[i]
    good = True
    for i in range(N):
        good = good and abs(out[i]) < LARGEST
    if not good:
        call(p[RESET], at(one[OWN_MODEL]), at(one[DATA]))  # removes all traces of the invalid state
        for i in range(N):
            out[i] = nan


@outline
@exact
def write_quaternion(x, first, qpos, q):
    """Write the quaternion of the rotation vector that begins at x[first]."""
    square = 0.0
    for i in range(3):
        square += x[first + i] * x[first + i]
    ratio = 0.5 * sine_ratio(0.25 * square)
    qpos[q] = cos(0.5 * sqrt(square))
    for i in range(3):
        qpos[q + 1 + i] = ratio * x[first + i]


@outline
@exact
def rotation_vector_near(qpos, q, near, first, out):
    """Write a quaternion's rotation vector to out[first], the vector nearest to the vector in `near`."""
    sine, along, length = 0.0, 0.0, 0.0
    for i in range(3):
        sine += qpos[q + 1 + i] * qpos[q + 1 + i]
        along += qpos[q + 1 + i] * near[first + i]
        length += near[first + i] * near[first + i]
    sine = sqrt(sine)
    if sine < 1e-150:
        # The identity has any axis; use the axis of `near`.
        turns = 2 * pi * nearest_whole(sqrt(length) / (2 * pi))
        scale = turns / sqrt(length) if turns > 0 else 0.0
        for i in range(3):
            out[first + i] = scale * near[first + i]
        return
    angle = 2 * atan2(sine, qpos[q])
    angle += 2 * pi * nearest_whole((along / sine - angle) / (2 * pi))
    for i in range(3):
        out[first + i] = angle / sine * qpos[q + 1 + i]


def nearest_whole(number):
    """The nearest whole number."""
    return float(int(number + 0.5)) if number >= 0 else -float(int(0.5 - number))
