"""MuJoCo's functions, called at their addresses: its steps as dynamics, distances of geoms, and places of balls.

States are tangent coordinates: a position for each degree of freedom, then the velocities, then the actuators' own
states. The rotation of a ball or free joint is three numbers: a rotation vector, or a turn about an axis after a tilt,
see `rotations.py`. `p` has the wrench on the body that `MjcfPhysics(body=...)` names, then addresses and sizes, at the
indices named below; `problem/mjcf_dynamics.py` writes it. Several threads may run these functions at once. Each takes a
slot, an `MjData` that it owns for as long as it needs it. If bodies carry loads, a slot also has its own model.

A step and its helper functions are compiled separately. Functions that do arithmetic here are therefore `outline` and
`exact`. Otherwise LLVM would reorder sums depending on where they are inlined, and bits would depend on the thread.

For distances by `mj_geomDistance`, `data` has:
  0: the address of p. 1: number of rows. 2: number of pairs of geoms. 3: largest distance of interest.
  Then for each pair: its row; the robot's geom, and its body; the other geom, an obstacle's or on another body of the
  robot; the sum of the radii of their bounding spheres; 1 if the other is a plane, else 0; the other's body if that
  moves, else 0.

A row is the least distance of its pairs. Pairs whose bounding spheres are farther apart than the least distance so far
are skipped.

For balls, points fixed to bodies, `data` has the address of p, the number of balls, and for each the number of its body
and its place in the body's axes; `differences.py` has the derivatives.
"""

from math import atan2, cos, nan, pi, sin, sqrt

from lqrsim.kernels.declarations import (
    M,
    N,
    W,
    at,
    call,
    call_for_value,
    claim,
    exact,
    fetch_add,
    int32,
    load,
    outline,
    rows_at,
    stack,
    store,
    zeros,
)
from lqrsim.kernels.linear_algebra import copy, copy_matrix, copy_part, fill
from lqrsim.kernels.rotation_ratios import cosine_ratio, cubic_ratio, sine_ratio

# The layout of p. WRENCH: force and torque on the body, world axes, 6 numbers. FLAGS, SLOTS, COUNT: flags of the slots
# in use, address of their numbers, number of slots. MODEL: MuJoCo's model. STEP, STEP_SKIP: the addresses of mj_step
# and mj_stepSkip. KEEPS: whether stages of a step can be kept for the next. TIMESTEP: timestep of the physics, in s.
# NV, NA: numbers of degrees of freedom and of actuators' states. JOINTS: number of joints. TEAM, JOB: addresses at
# which helper threads find their work, 0 without helpers; YIELD: the address of the function that yields to other
# threads; KINEMATICS, RESET, COMPOS, JAC, DISTANCE: the addresses of mj_kinematics, mj_resetData, mj_comPos, mj_jac
# and mj_geomDistance; DISTANCE_MODEL: the model for distances. LOADED, LOADS: number of bodies that may carry a load,
# and index of the loads, in kg; the numbers of these bodies and their own masses follow. CONSTANTS: the address of
# mj_setConst. AXIS: the axis of turns, a one and two zeros; three zeros for rotation vectors. TABLE: the joints' kind
# and places in qpos and qvel, three numbers each.
WRENCH, FLAGS, SLOTS, COUNT, MODEL, STEP, STEP_SKIP, KEEPS = 0, 6, 7, 8, 9, 10, 11, 12
TIMESTEP, NV, NA, JOINTS, TEAM, JOB, YIELD, KINEMATICS = 13, 14, 15, 16, 17, 18, 19, 20
RESET, COMPOS, JAC, DISTANCE, DISTANCE_MODEL, LOADED, LOADS, CONSTANTS = 21, 22, 23, 24, 25, 26, 27, 28
AXIS, TABLE = 29, 32

# Addresses that a slot has for its MjData, and their number.
DATA, QPOS, QVEL, ACT, CTRL, WARM, QACC, XFRC_APPLIED, XPOS, XMAT = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9
GEOM_XPOS, GEOM_XMAT, OWN_MODEL, MASSES, SLOT = 10, 11, 12, 13, 14

# The words that a team shares: whether it is in use, the next column, combined with the number of the job, the number
# of finished columns, whether to stop, the number of helpers, and whether a signal came, after which all steps are NaN.
BUSY, TICKET, DONE, STOP, HELPERS, SIGNALLED = 0, 1, 2, 3, 4, 5
JOBS = 65536  # the ticket is JOBS * job + column
PATIENT = 2000  # number of looks at the ticket before a helper lets other threads run

# The width of differences, relative to a number or to 1. Rounding errors, some 1e-15 of a physics step, are then 1e-9
# of a derivative; at a jump, as where a body just touches, narrower differences would be steeper. Differences to one
# side suffice while their error, relative to the largest entry, is below CURVED: it is 1e-7 to 1e-6 in free motion of
# arms, less after the errors of neighbouring steps have cancelled, and 1e-5 to 1e-2 with contacts.
WIDTH, CURVED = 1e-6, 1e-5

FREE, BALL = 0, 1  # MuJoCo's kinds of joints that have a rotation
LARGEST = 1e10  # mjMAXVAL: MuJoCo treats larger numbers as an unstable simulation

ROWS = 1  # number of rows of distances
REACH, PAIRS, PAIR_LENGTH = 3, 4, 7  # indices of the largest distance and of the pairs in data; numbers of each pair
TOUCHING = 1e-12  # m; the segment between two geoms that touch has no direction


def advance(x, u, p, h, out):
    """Write the state after `h` seconds, (N,): a whole number of physics steps; NaN if it overflows."""
    z = stack(W)
    substeps = steps_in(x, u, p, h, z)
    if substeps < 1:
        fill(out, N, nan)
        return
    slot = claim_slot(p)
    run(z, p, substeps, at(p[SLOTS] + 8 * SLOT * slot), out)
    store(p[FLAGS], slot, 0)


def step_jacobian(x, u, p, h, out, jacobian):
    """Write the same step and its Jacobian `[A B]` (N, W): the product of those of the physics steps.

    The Jacobian of a physics step is of one-sided differences; and of both sides, where the step is too curved.
    Free helpers also compute columns. The bits do not depend on which thread computed a column.
    """
    z = stack(W)
    substeps = steps_in(x, u, p, h, z)
    if substeps < 1:
        fill(out, N, nan)
        for i in range(N):
            fill(jacobian[i], W, nan)
        return
    team, slot = p[TEAM], claim_slot(p)
    together = team != 0 and load(team, HELPERS) > 0 and claim(team, BUSY) == 1
    addresses, before, accelerations, arrived = at(p[SLOTS] + 8 * SLOT * slot), zeros(N), zeros(N), stack(N)
    columns, other_side = stack(N, W), stack(N, W)
    run(z, p, substeps, addresses, out)
    for k in range(substeps):
        # Errors of one-sided differences change their sign with the side: those of neighbouring steps nearly cancel.
        side = 1.0 if k % 2 == 0 else -1.0
        difference(z, p, side, together, addresses, before, accelerations, arrived, columns)
        if curved(z, p, side, addresses, accelerations, arrived, columns):
            difference(z, p, -side, together, addresses, before, accelerations, arrived, other_side)
            for i in range(N):
                for j in range(W):
                    columns[i, j] = 0.5 * (columns[i, j] + other_side[i, j])
        if k == 0:
            copy_matrix(columns, N, W, jacobian)
        else:
            chain(columns, jacobian)
        copy(arrived, N, z)
        copy(accelerations, N, before)
    if together:
        store(team, BUSY, 0)
    store(p[FLAGS], slot, 0)


def difference(z, p, side, together, addresses, before, accelerations, arrived, columns):
    """Write the Jacobian of a physics step by differences to one side, with the helpers if there is a team.

    Args:
      side: 1 or -1. addresses: of a slot.
      before: (N,) accelerations of the step before, at which MuJoCo's solver begins. accelerations, arrived: (N,) those
        of this step and the state after it, written.
    """
    if together:
        publish(z, p, side, before)
    linearize_here(z, p, p, addresses, before, accelerations, arrived)
    if together:
        share_columns(z, p, side, addresses, accelerations, arrived, columns)
    else:
        for k in range(W):
            column(k, z, p, side, addresses, accelerations, arrived, columns)


@outline
@exact
def curved(z, p, side, addresses, accelerations, arrived, columns):
    """Whether one-sided differences of a physics step are too inexact.

    A change of everything at once, to the other side, then leads elsewhere than the columns say.
    """
    perturbed, reached, off, largest = stack(W), stack(N), 0.0, 0.0
    for j in range(W):
        perturbed[j] = z[j] - side * WIDTH * max(1.0, abs(z[j]))
    step_from(perturbed, z, p, addresses, accelerations, 0, reached)
    for i in range(N):
        expected = arrived[i]
        for j in range(W):
            expected += columns[i, j] * (perturbed[j] - z[j])
            largest = max(largest, abs(columns[i, j]))
        off = max(off, abs(reached[i] - expected))
    return off > 2 * CURVED * WIDTH * largest  # twice, as the errors of both sides add up


@outline
@exact
def chain(columns, jacobian):
    """Chain a physics step [A B] to the Jacobian of the steps before: A times it, plus B in the controls' columns."""
    before = stack(N, W)
    copy_matrix(jacobian, N, W, before)
    for i in range(N):
        for j in range(W):
            jacobian[i, j] = columns[i, j] if j >= N else 0.0
        for k in range(N):
            for j in range(W):
                jacobian[i, j] += columns[i, k] * before[k, j]


def publish(z, p, side, before):
    """Hand a job to the helpers: the side, the state and the control, the accelerations before, and the wrench."""
    team, job = p[TEAM], at(p[JOB])
    job[0] = side
    copy_part(z, 0, job, 1, W)
    copy_part(before, 0, job, 1 + W, N)
    copy_part(p, WRENCH, job, 1 + W + N, 6)
    store(team, DONE, 0)
    store(team, TICKET, JOBS * (load(team, TICKET) // JOBS + 1))


def share_columns(z, p, side, addresses, accelerations, arrived, columns):
    """Compute columns of the job that helpers also have, and write all."""
    team, shared, patience = p[TEAM], job_columns(p), 0
    k = fetch_add(team, TICKET, 1) % JOBS
    while k < W:
        column(k, z, p, side, addresses, accelerations, arrived, shared)
        fetch_add(team, DONE, 1)
        k = fetch_add(team, TICKET, 1) % JOBS
    while load(team, DONE) < W:  # a helper still has work to do, once it gets to run
        patience += 1
        if patience > PATIENT and p[YIELD] != 0:
            call(p[YIELD])
    copy_matrix(shared, N, W, columns)


def help_out(p):
    """Compute columns for the threads that linearise, until told to stop.

    A thread takes a column first, and reads its job afterwards. Until the column is done, no other job is written.
    """
    team, slot, known, patience = p[TEAM], claim_slot(p), -1, 0
    addresses, job, columns = at(p[SLOTS] + 8 * SLOT * slot), at(p[JOB]), job_columns(p)
    z, wrench, before, accelerations, arrived = stack(W), stack(6), stack(N), zeros(N), stack(N)
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
            copy_part(job, 1, z, 0, W)
            copy_part(job, 1 + W, before, 0, N)
            copy_part(job, 1 + W + N, wrench, 0, 6)
            linearize_here(z, p, wrench, addresses, before, accelerations, arrived)
        column(ticket % JOBS, z, p, job[0], addresses, accelerations, arrived, columns)
        fetch_add(team, DONE, 1)
    store(p[FLAGS], slot, 0)


def job_columns(p):
    """Destination of a job's columns: rows of W numbers."""
    return rows_at(p[JOB] + 8 * (1 + W + N + 6), W)


def run(z, p, substeps, addresses, out):
    """Write the state after this number of physics steps."""
    none = zeros(N)
    write_loads(p, addresses)
    write_to(z, p, addresses)
    apply_wrench(p, addresses)
    start_from(p, addresses, none)  # so that it is independent of earlier steps
    for _ in range(substeps):
        call(p[STEP], at(addresses[OWN_MODEL]), at(addresses[DATA]))
    read_from(z, p, addresses, out)


def linearize_here(z, p, wrench, addresses, before, accelerations, arrived):
    """Bring the MjData of a slot to the stages of a physics step, from which columns keep what does not change."""
    write_loads(p, addresses)
    apply_wrench(wrench, addresses)
    step_from(z, z, p, addresses, before, 0, arrived)
    copy(at(addresses[QACC]), int(p[NV]), accelerations)
    step_from(z, z, p, addresses, accelerations, 2, arrived)


@outline
@exact
def column(k, z, p, side, addresses, accelerations, arrived, jacobian):
    """Write the k-th column of a physics step's Jacobian, after `linearize_here`.

    Controls come first, then actuators' states, velocities and positions, each of which changes an earlier stage of a
    step: what comes before that stage is kept. MuJoCo's solver starts at the solution of the unperturbed step. Both
    steps then end equally near to their solutions, so that the solver's tolerance is not divided by the difference.
    """
    perturbed, reached, nv = stack(W), stack(N), int(p[NV])
    copy(z, W, perturbed)
    j = k + N if k < M else W - 1 - k
    perturbed[j] += side * WIDTH * max(1.0, abs(z[j]))
    step_from(perturbed, z, p, addresses, accelerations, 2 if j >= 2 * nv else 1 if j >= nv else 0, reached)
    for i in range(N):
        jacobian[i, j] = (reached[i] - arrived[i]) / (perturbed[j] - z[j])


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


def claim_slot(p):
    """Claim a free slot."""
    slot, count = 0, int(p[COUNT])
    while claim(p[FLAGS], slot) == 0:
        slot = (slot + 1) % count
    return slot


def write_to(z, p, addresses):
    """Write a state and a control into an MjData."""
    nv = int(p[NV])
    write_positions(z, p, at(addresses[QPOS]))
    copy_part(z, nv, at(addresses[QVEL]), 0, nv)
    copy_part(z, 2 * nv, at(addresses[ACT]), 0, int(p[NA]))
    copy_part(z, N, at(addresses[CTRL]), 0, M)


def write_positions(x, p, qpos):
    """Write MuJoCo's positions of a state."""
    for k in range(int(p[JOINTS])):
        kind, q, d = int(p[TABLE + 3 * k]), int(p[TABLE + 3 * k + 1]), int(p[TABLE + 3 * k + 2])
        if kind == FREE:
            copy_part(x, d, qpos, q, 3)
            write_quaternion(x, d + 3, p, qpos, q + 3)
        elif kind == BALL:
            write_quaternion(x, d, p, qpos, q)
        else:
            qpos[q] = x[d]


def apply_wrench(wrench, addresses):
    """Apply the wrench to its body."""
    copy_part(wrench, WRENCH, at(addresses[XFRC_APPLIED]), 0, 6)


def write_loads(p, addresses):
    """Add the loads to the bodies, at their centres of mass, in the model of the slot. Changes the MjData's positions.

    MuJoCo's constants follow the masses: inertias of bodies that float freely, and the inverse inertias by which the
    softness of contacts, limits, friction and equality constraints is scaled.
    """
    count, first, masses = int(p[LOADED]), int(p[LOADS]), at(addresses[MASSES])
    changed = False
    for k in range(count):
        body, mass = int(p[first + count + k]), p[first + 2 * count + k] + p[first + k]
        changed = changed or masses[body] != mass
        masses[body] = mass
    if changed:
        call(p[CONSTANTS], at(addresses[OWN_MODEL]), at(addresses[DATA]))


def start_from(p, addresses, guess):
    """Let the solver of the next step begin at these accelerations."""
    copy(guess, int(p[NV]), at(addresses[WARM]))


def step_from(z, reference, p, addresses, guess, stages, out):
    """Write the state after a physics step, which keeps that number of stages of the MjData if it can."""
    write_to(z, p, addresses)
    start_from(p, addresses, guess)
    call(p[STEP_SKIP], at(addresses[OWN_MODEL]), at(addresses[DATA]), int32(stages if p[KEEPS] != 0 else 0), int32(1))
    read_from(reference, p, addresses, out)


def read_from(reference, p, addresses, out):
    """Write the state of an MjData, with the rotations nearest to those in `reference`; NaN if invalid."""
    nv, na = int(p[NV]), int(p[NA])
    qpos, qvel, act = at(addresses[QPOS]), at(addresses[QVEL]), at(addresses[ACT])
    for k in range(int(p[JOINTS])):
        kind, q, d = int(p[TABLE + 3 * k]), int(p[TABLE + 3 * k + 1]), int(p[TABLE + 3 * k + 2])
        if kind == FREE:
            copy_part(qpos, q, out, d, 3)
            rotation_near(qpos, q + 3, p, reference, d + 3, out)
        elif kind == BALL:
            rotation_near(qpos, q, p, reference, d, out)
        else:
            out[d] = qpos[q]
    copy_part(qvel, 0, out, nv, nv)
    copy_part(act, 0, out, 2 * nv, na)
    good = True
    for i in range(N):
        good = good and abs(out[i]) < LARGEST
    if not good:
        call(p[RESET], at(addresses[OWN_MODEL]), at(addresses[DATA]))  # removes all traces of the invalid state
        fill(out, N, nan)


@outline
@exact
def write_quaternion(x, first, p, qpos, q):
    """Write the quaternion of the rotation that begins at x[first]: its tilt, then its turn about the axis."""
    tilt, turn, square = stack(3), 0.0, 0.0
    for i in range(3):
        turn += p[AXIS + i] * x[first + i]
        tilt[i] = (1.0 - p[AXIS + i]) * x[first + i]
        square += tilt[i] * tilt[i]
    scalar, ratio = cos(0.5 * sqrt(square)), 0.5 * sine_ratio(0.25 * square)
    cosine, sine = cos(0.5 * turn), sin(0.5 * turn)
    qpos[q] = cosine * scalar
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        across = p[AXIS + j] * tilt[k] - p[AXIS + k] * tilt[j]
        qpos[q + 1 + i] = ratio * (cosine * tilt[i] + sine * across) + sine * scalar * p[AXIS + i]


@outline
@exact
def rotation_near(qpos, q, p, reference, first, out):
    """Write a quaternion's rotation, nearest to that in `reference` in its turn and its tilt, to out[first]."""
    along, turn = 0.0, 0.0
    for i in range(3):
        along += p[AXIS + i] * qpos[q + 1 + i]
        turn += p[AXIS + i] * reference[first + i]
    turned = 2 * atan2(along, qpos[q])
    turned += 2 * pi * nearest_whole((turn - turned) / (2 * pi))
    # The quaternion without its turn is (scalar, tilt); the sign is such that the scalar is not negative.
    scalar = sqrt(qpos[q] * qpos[q] + along * along)
    cosine, sine = (qpos[q] / scalar, along / scalar) if scalar > 0 else (1.0, 0.0)
    tilt, goal, square, inner, goal_square = stack(3), stack(3), 0.0, 0.0, 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        across = p[AXIS + j] * qpos[q + 1 + k] - p[AXIS + k] * qpos[q + 1 + j]
        tilt[i] = (1.0 - p[AXIS + i]) * (cosine * qpos[q + 1 + i] - sine * across)
        goal[i] = (1.0 - p[AXIS + i]) * reference[first + i]
        square += tilt[i] * tilt[i]
        inner += tilt[i] * goal[i]
        goal_square += goal[i] * goal[i]
    size, goal_length = sqrt(square), sqrt(goal_square)
    if size < 1e-150:
        # The identity has any axis; use the axis of `reference`.
        turns = 2 * pi * nearest_whole(goal_length / (2 * pi))
        scale = turns / goal_length if turns > 0 else 0.0
        for i in range(3):
            out[first + i] = scale * goal[i] + turned * p[AXIS + i]
        return
    angle = 2 * atan2(size, scalar)
    angle += 2 * pi * nearest_whole((inner / size - angle) / (2 * pi))
    for i in range(3):
        out[first + i] = angle / size * tilt[i] + turned * p[AXIS + i]


def nearest_whole(number):
    """The nearest whole number."""
    return float(int(number + 0.5)) if number >= 0 else -float(int(0.5 - number))


# Distances, and places of balls.


def residual(x, data, out):
    """Write the least distance of each row, in metres; at most the largest distance of interest."""
    which, segments, nowhere = stack(ROWS), stack(ROWS, 6), stack(1)
    find_nearest(x, nowhere, -1, data, 0, out, which, segments)


def residual_jacobian(x, data, out, slopes):
    """Write the distances and their derivatives in the states (any, N), which are zero on entry."""
    which, segments = stack(ROWS), stack(ROWS, 6)
    find_nearest_with_slopes(x, data, 0, out, slopes, which, segments)


def distances_of(count, states, per_displacement, displaced, data, out, which, segments):
    """Write the distances, row by row, at states (count, N).

    For `per_displacement` consecutive states obstacles have the same displacements, three numbers per row.
    """
    rows = int(data[1])
    for i in range(count):
        find_nearest(states[i], displaced, 3 * rows * (i // per_displacement), data, rows * i, out, which, segments)


def slopes_of(count, states, data, out, slopes, which, segments):
    """Write the distances and their derivatives (any, N), which are zero on entry, at states (count, N)."""
    rows = int(data[1])
    for i in range(count):
        find_nearest_with_slopes(states[i], data, rows * i, out, slopes, which, segments)


def places(x, data, out):
    """Write the coordinates of the balls, ball by ball."""
    p = at(data[0])
    slot = claim_slot(p)
    addresses = at(p[SLOTS] + 8 * SLOT * slot)
    move_bodies(x, p, addresses)
    origins, axes = at(addresses[XPOS]), at(addresses[XMAT])
    for k in range(int(data[1])):
        body = int(data[2 + 4 * k])
        for i in range(3):
            place = origins[3 * body + i]
            for j in range(3):
                place += axes[9 * body + 3 * i + j] * data[3 + 4 * k + j]
            out[3 * k + i] = place
    store(p[FLAGS], slot, 0)


def move_bodies(x, p, addresses):
    """Move the bodies of an MjData to the positions of a state."""
    write_positions(x, p, at(addresses[QPOS]))
    call(p[KINEMATICS], at(p[MODEL]), at(addresses[DATA]))


@outline
def find_nearest(x, displaced, offset, data, first, out, which, segments):
    """Write the least distance of each row to out from `first` on, its pair, or -1, and the segment between the two."""
    p = at(data[0])
    slot = claim_slot(p)
    addresses = at(p[SLOTS] + 8 * SLOT * slot)
    move_bodies(x, p, addresses)
    find_nearest_with_data(p, addresses, data, displaced, offset, first, out, which, segments)
    store(p[FLAGS], slot, 0)


def find_nearest_with_slopes(x, data, first, out, slopes, which, segments):
    """As `find_nearest`, with derivatives: minus the velocity of the robot's nearest point along the normal.

    The normal points to the other geom. If that moves, too, it is the relative velocity.
    """
    p = at(data[0])
    slot, nv = claim_slot(p), int(p[NV])
    addresses = at(p[SLOTS] + 8 * SLOT * slot)
    moves, others, normal, there, nowhere = stack(3 * N), stack(3 * N), stack(3), stack(3), stack(1)
    move_bodies(x, p, addresses)
    call(p[COMPOS], at(p[MODEL]), at(addresses[DATA]))
    find_nearest_with_data(p, addresses, data, nowhere, -1, first, out, which, segments)
    for row in range(int(data[1])):
        if which[row] >= 0:
            pair = PAIRS + PAIR_LENGTH * int(which[row])
            write_normal(addresses, int(data[pair + 1]), int(data[pair + 3]), out[first + row], segments[row], normal)
            call(p[JAC], at(p[MODEL]), at(addresses[DATA]), moves, 0, segments[row], int32(int(data[pair + 2])))
            if data[pair + 6] > 0:
                copy_part(segments[row], 3, there, 0, 3)
                call(p[JAC], at(p[MODEL]), at(addresses[DATA]), others, 0, there, int32(int(data[pair + 6])))
                for j in range(3 * nv):
                    moves[j] -= others[j]
            for j in range(nv):
                for i in range(3):
                    slopes[first + row, j] -= normal[i] * moves[nv * i + j]
            turn_to_states(x, p, slopes[first + row])
    store(p[FLAGS], slot, 0)


def find_nearest_with_data(p, addresses, data, displaced, offset, first, out, which, segments):
    """As `find_nearest`, of an MjData that has its positions.

    If `offset` is not negative, obstacles are displaced by the three numbers from displaced[offset + 3 row] on.
    """
    middles, axes, segment = at(addresses[GEOM_XPOS]), at(addresses[GEOM_XMAT]), stack(6)
    for row in range(int(data[1])):
        out[first + row], which[row] = data[REACH], -1.0
    for k in range(int(data[2])):
        pair = PAIRS + PAIR_LENGTH * k
        row, robot, other = int(data[pair]), 3 * int(data[pair + 1]), 3 * int(data[pair + 3])
        before_x, before_y, before_z = middles[other], middles[other + 1], middles[other + 2]
        if offset >= 0:
            for i in range(3):
                middles[other + i] += displaced[offset + 3 * row + i]
        x, y, z = middles[robot] - middles[other], middles[robot + 1] - middles[other + 1], middles[robot + 2]
        z -= middles[other + 2]
        if data[pair + 5] == 1:
            apart = axes[3 * other + 2] * x + axes[3 * other + 5] * y + axes[3 * other + 8] * z
        else:
            apart = sqrt(x * x + y * y + z * z)
        least = out[first + row]
        if not apart - data[pair + 4] >= least:
            distance = call_for_value(
                p[DISTANCE], at(p[DISTANCE_MODEL]), at(addresses[DATA]), int32(robot // 3), int32(other // 3),
                least, segment,
            )  # fmt: skip
            if not distance >= least:
                out[first + row], which[row] = distance, float(k)
                copy(segment, 6, segments[row])
        middles[other], middles[other + 1], middles[other + 2] = before_x, before_y, before_z


def write_normal(addresses, robot, other, distance, segment, normal):
    """Write the direction from the robot's nearest point to the obstacle's; if both coincide, from centre to centre."""
    length = 0.0
    for i in range(3):
        normal[i] = segment[3 + i] - segment[i]
        length += normal[i] * normal[i]
    sign = 1.0 if distance >= 0 else -1.0
    if length < TOUCHING * TOUCHING:
        middles = at(addresses[GEOM_XPOS])
        sign, length = 1.0, 0.0
        for i in range(3):
            normal[i] = middles[3 * other + i] - middles[3 * robot + i]
            length += normal[i] * normal[i]
    scale = sign / sqrt(length) if length > 0 else 0.0
    for i in range(3):
        normal[i] *= scale


def turn_to_states(x, p, slope):
    """Convert a derivative in angular velocities, in place, to a derivative in the states' rotations.

    A tilt t that changes by dt turns the body by dt - cosine t x dt + cubic t x (t x dt), in its own axes; a turn about
    an axis n that changes by ds, by n - sine t x n + cosine t x (t x n) times ds. Without an axis all is tilt.
    """
    tilt, once, twice = stack(3), stack(3), stack(3)
    for k in range(int(p[JOINTS])):
        kind, d = int(p[TABLE + 3 * k]), int(p[TABLE + 3 * k + 2])
        if kind <= BALL:
            d = d + 3 if kind == FREE else d
            for i in range(3):
                tilt[i] = (1.0 - p[AXIS + i]) * x[d + i]
            square = tilt[0] * tilt[0] + tilt[1] * tilt[1] + tilt[2] * tilt[2]
            cross(tilt, slope[d], slope[d + 1], slope[d + 2], once)
            cross(tilt, once[0], once[1], once[2], twice)
            for i in range(3):
                if p[AXIS + i] == 1:
                    slope[d + i] += sine_ratio(square) * once[i] + cosine_ratio(square) * twice[i]
                else:
                    slope[d + i] += cosine_ratio(square) * once[i] + cubic_ratio(square) * twice[i]


def cross(tilt, a, b, c, out):
    """Write tilt x (a, b, c)."""
    out[0] = tilt[1] * c - tilt[2] * b
    out[1] = tilt[2] * a - tilt[0] * c
    out[2] = tilt[0] * b - tilt[1] * a
