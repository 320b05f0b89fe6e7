"""Robots with every kind of actuator, dynamics, transmission and limit, and rest found without lqrsim."""

from dataclasses import dataclass

import mujoco
import numpy as np
from mechanisms import NO_CONTACT, scene
from numpy.random import Generator
from scipy.optimize import least_squares

_TRIES = 6  # starts of the search for rest
_REST = 1e-8  # N, N m and rates within which something rests
_INTEGRALS = {mujoco.mjtDyn.mjDYN_PID: (0, 1), mujoco.mjtDyn.mjDYN_DCMOTOR: (8, 7)}  # entries of imax and slewmax


@dataclass(frozen=True)
class Actuated:
    """An MJCF, its kinds of actuators, and the positions of its joints by name at which it is to be held."""

    xml: str
    kinds: tuple[str, ...]
    places: dict[str, float]


def draw(seed: int) -> Actuated:
    """An arm, a gantry, a pendulum on a ball joint, or a free body.

    Springs of joints outweigh gravity, so that rest is stable whatever holds it; a free body is neutral.
    """
    rng = np.random.default_rng(seed)
    while True:
        drawn = (_arm, _arm, _arm, _gantry, _ball, _free)[int(rng.integers(6))](rng)
        if any("without input" not in kind for kind in drawn.kinds):
            return drawn


def _arm(rng: Generator) -> Actuated:
    count = int(rng.integers(1, 4))
    names = [f"j{i}" for i in range(count)]
    bodies = ""
    for name in names:
        bodies += (
            f'<body name="{name}" pos="{0.3 if bodies else 0} 0 0"><joint name="{name}" axis="0 1 0" damping="1"'
            f' armature="0.05" stiffness="{rng.uniform(15, 30)}" springref="{rng.uniform(-40, 40)}" {_joint(rng)}/>'
            f'<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="{rng.uniform(0.1, 0.5)}" {NO_CONTACT}/>'
            f'<site name="{name}_tip" pos="0.3 0 0"/><site name="{name}_side" pos="0.15 0 0.03"/>'
        )
    bodies += "</body>" * count
    above = '<site name="above" pos="0.1 0 0.5"/><site name="post" pos="0.05 0 -0.3" euler="0 20 0"/>'
    tendons, actuators, kinds = "", "", []
    for i, name in enumerate(names):
        through = rng.choice(["joint", "joint", "jointinparent", "fixed", "spatial", "site", "refsite", "crank"])
        where = f'{through}="{name}"'
        if through == "fixed":
            other = names[int(rng.integers(count))]
            second = f'<joint joint="{other}" coef="{rng.uniform(-0.5, 0.5)}"/>' if other != name else ""
            tendons += f'<fixed name="t{i}" {_tendon(rng)}><joint joint="{name}" coef="{_gear(rng)}"/>{second}</fixed>'
            where = f'tendon="t{i}"'
        elif through == "spatial":
            tendons += f'<spatial name="t{i}" {_tendon(rng)}><site site="above"/><site site="{name}_side"/></spatial>'
            where = f'tendon="t{i}" gear="{_gear(rng) * 10}"'
        elif through == "site":
            where = f'site="{name}_tip" gear="0 0 {_gear(rng)} 0 {_gear(rng)} 0"'
        elif through == "refsite":
            where = f'site="{name}_tip" refsite="post" gear="0 0 {_gear(rng)} 0 0 0"'
        elif through == "crank":
            where = f'cranksite="{name}_side" slidersite="post" cranklength="0.8" gear="{_gear(rng) * 10}"'
        else:
            where += f' gear="{_gear(rng)}"'
        for k in range(int(rng.integers(1, 3))):
            kind, text = _actuator(rng, f'name="a{i}{k}" {where}')
            actuators, kinds = actuators + text, [*kinds, f"{kind}, {through}"]
    places = {name: float(rng.uniform(-0.7, 0.7)) for name in names}
    return Actuated(_file(above + bodies, tendons, actuators), tuple(kinds), places)


def _gantry(rng: Generator) -> Actuated:
    bodies, actuators, kinds, places = "", "", [], {}
    for i in range(int(rng.integers(1, 3))):
        slope = rng.uniform(0.3, 1)
        bodies += (
            f'<body name="s{i}" pos="0 {i} 0"><joint name="s{i}" type="slide" axis="1 0 {slope}" damping="10"'
            f' stiffness="{rng.uniform(50, 200)}" {_joint(rng)}/><geom size="0.05" mass="0.4" {NO_CONTACT}/></body>'
        )
        for k in range(int(rng.integers(1, 3))):
            kind, text = _actuator(rng, f'name="a{i}{k}" joint="s{i}" gear="{_gear(rng)}"')
            actuators, kinds = actuators + text, [*kinds, f"{kind}, slide"]
        places[f"s{i}"] = float(rng.uniform(-0.05, 0.05))
    return Actuated(_file(bodies, "", actuators), tuple(kinds), places)


def _ball(rng: Generator) -> Actuated:
    body = (
        f'<body name="b" pos="0 0 0"><joint name="b" type="ball" damping="1" armature="0.05" stiffness="20"/>'
        f'<geom type="capsule" fromto="0 0 0 0.2 0.1 0.1" size="0.02" mass="{rng.uniform(0.1, 0.5)}" {NO_CONTACT}/>'
        '<site name="tip"/></body><site name="post"/>'
    )
    actuators, kinds = "", []
    if rng.random() < 0.5:
        where = 'joint="b"' if rng.random() < 0.5 else 'site="tip" refsite="post"'
        least = f'forcerange="0 {rng.uniform(0.2, 4)}"' if rng.random() < 0.3 else ""
        chart = rng.choice(["expmap", "quat"])
        actuators += f'<orientation {where} kp="{rng.uniform(2, 20)}" kv="1" input="{chart}" {least}/>'
        kinds.append(f"orientation by {chart}")
    else:
        through = rng.choice(["joint", "jointinparent"])
        for k, axis in enumerate(("1 0 0", "0 1 0", "0 0 1")):
            kind, text = _actuator(rng, f'name="a{k}" {through}="b" gear="{axis} 0 0 0"')
            actuators, kinds = actuators + text, [*kinds, f"{kind}, {through} of a ball"]
    places = {f"b_r{axis}": float(rng.uniform(-0.5, 0.5)) for axis in "xyz"}
    return Actuated(_file(body, "", actuators), tuple(kinds), places)


def _free(rng: Generator) -> Actuated:
    """A box with six or more thrusters, each along and about an axis."""
    sites, actuators, kinds = "", "", []
    for k in range(int(rng.integers(6, 9))):
        place, gear = " ".join(map(str, rng.uniform(-0.2, 0.2, 3))), " ".join(map(str, rng.normal(size=6)))
        sites += f'<site name="s{k}" pos="{place}"/>'
        limits = _range("ctrlrange", rng, 5) if rng.random() < 0.3 else ""
        lag = rng.choice(["", 'dyntype="filter" dynprm="0.05"', 'dyntype="filterexact" dynprm="0.001"'])
        actuators += f'<general name="a{k}" site="s{k}" gear="{gear}" gainprm="{rng.uniform(0.5, 3)}" {lag} {limits}/>'
        kinds.append("thruster" + (f" with {lag.split()[0]}" if lag else ""))
    box = f'<geom type="box" size="0.2 0.1 0.05" mass="0.8" {NO_CONTACT}/>'
    body = f'<body name="f"><freejoint name="f"/>{box}{sites}</body>'
    return Actuated(_file(body, "", actuators), tuple(kinds), {"f_rx": float(rng.uniform(-1, 1))})


def _file(bodies: str, tendons: str, actuators: str) -> str:
    option = 'timestep="0.002" integrator="implicitfast"'
    return scene(bodies, actuators, more=f"<tendon>{tendons}</tendon>", option=option, compiler="")


def _gear(rng: Generator) -> float:
    return float(rng.choice([-1, 1]) * rng.uniform(0.3, 3))


def _range(name: str, rng: Generator, size: float, *, about: float = 0.0) -> str:
    """A range that need not contain 0."""
    low, high = np.sort(about + rng.uniform(-size, size, 2))
    return f'{name}="{low} {high + 1e-3}"'


def _joint(rng: Generator) -> str:
    return f'actuatorfrcrange="{-rng.uniform(0.2, 8)} {rng.uniform(0.2, 8)}"' if rng.random() < 0.2 else ""


def _tendon(rng: Generator) -> str:
    return f'actuatorfrcrange="{-rng.uniform(0.2, 8)} {rng.uniform(0.2, 8)}"' if rng.random() < 0.2 else ""


def _actuator(rng: Generator, where: str) -> tuple[str, str]:
    """Its kind, and an actuator at this place."""
    kp, kv = rng.uniform(2, 40), rng.uniform(0.1, 2)
    force = _range("forcerange", rng, 10) if rng.random() < 0.25 else ""
    limit = _range("ctrlrange", rng, 4) if rng.random() < 0.3 else ""
    act = _range("actrange", rng, 4) if rng.random() < 0.3 else ""
    muscle = _range("ctrlrange", rng, 0.5, about=0.5) if rng.random() < 0.3 else ""
    slew = f'slewmax="{rng.uniform(0.05, 2)}"' if rng.random() < 0.5 else ""
    inputs = rng.choice(["pos", "pos vel", "pos ff", "pos vel ff"])
    lag = rng.uniform(0.02, 0.2)
    few, shift = rng.choice([0.0, 0.2]), rng.choice([0.0, 1.0])
    speeds, volts = rng.choice(["vel", "vel ff", "ff"]), rng.choice([0.0, 24.0])
    motor = f'motorconst="{rng.uniform(0.1, 0.6)} {rng.uniform(0.1, 0.6)}" resistance="{rng.uniform(0.3, 2)}"'
    affine = f'gainprm="{kp}" biastype="affine" biasprm="{rng.uniform(-1, 1)} -{kp} -{kv}"'
    made = {
        "motor": f"<motor {force} {limit} {{}}/>",
        "position": f'<position kp="{kp}" kv="{kv}" {force} {limit} {{}}/>',
        "position with a lag": f'<position kp="{kp}" kv="{kv}" timeconst="{lag}" {force} {limit} {{}}/>',
        "velocity": f'<velocity kv="{kv}" {force} {limit} {{}}/>',
        "intvelocity": f'<intvelocity kp="{kp}" {_range("actrange", rng, 4)} {force} {limit} {{}}/>',
        "damper": f'<damper kv="{kv}" ctrlrange="0 1" {force} {{}}/>',
        "cylinder": f'<cylinder timeconst="{lag}" area="2" bias="1 -2 0" {force} {limit} {{}}/>',
        "muscle": f'<muscle lengthrange="-1.5 1.5" force="{rng.uniform(5, 30)}" {muscle} {{}}/>',
        "integrator": f'<general dyntype="integrator" {affine} {act} {force} {limit} {{}}/>',
        "filter": f'<general dyntype="filter" dynprm="{lag}" {affine} {act} {force} {limit} {{}}/>',
        "filterexact": f'<general dyntype="filterexact" dynprm="{lag}" gainprm="{kp}" {act} {force} {limit} {{}}/>',
        "gain by length": f'<general gaintype="affine" gainprm="{kp} 2 0" {force} {limit} {{}}/>',
        "user": f'<general dyntype="user" gainprm="{kp}" {limit} {{}}/>',
        "pid": f'<pid kp="{kp}" kv="{kv}" input="{inputs}" {slew} {force} {limit} {{}}/>',
        "pid with ki": f'<pid kp="{kp}" kv="{kv}" ki="{0.2 * kp}" imax="{rng.uniform(0.05, 2)}" input="{inputs}"'
        f" {slew} {force} {limit} {{}}/>",
        "pid of velocity": f'<pid kp="{kp}" kv="{kv}" input="{speeds}" {force} {limit} {{}}/>',
        "dcmotor": f"<dcmotor {motor} {limit} {{}}/>",
        "dcmotor with inductance": f'<dcmotor {motor} inductance="0 {lag}" saturation="{rng.uniform(0.5, 5)} 0'
        f' {rng.choice([0, 20])}" {limit} {{}}/>',
        "dcmotor that warms": f'<dcmotor {motor} thermal="2 1 0 0.004 25 {rng.uniform(15, 40)}" {limit} {{}}/>',
        "dcmotor with friction": f'<dcmotor {motor} cogging="0.1 6 1" lugre="50 1 .1 .2 .1" {limit} {{}}/>',
        "dcmotor with a controller": f'<dcmotor {motor} input="{inputs}"'
        f' controller="{kp} {few * kp} {kv} {shift} 1 {volts}" {limit} {{}}/>',
        "dcmotor without input": f'<dcmotor {motor} input="none" {{}}/>',
    }  # fmt: skip
    if "site=" in where:
        del made["muscle"]  # MuJoCo has none of sites
    kind = str(rng.choice(list(made)))
    return kind, made[kind].format(where)


def bounds(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """The least and largest controls and activations, (nu + na,) each: ranges, and integrals' anti-windup limits."""
    low, high = np.full(model.nu + model.na, -np.inf), np.full(model.nu + model.na, np.inf)
    for number in range(model.nactuator):
        own = slice(
            int(model.actuator_ctrladr[number]), int(model.actuator_ctrladr[number] + model.actuator_ctrlnum[number])
        )
        for k in range(own.start, own.stop):
            if model.actuator_ctrllimited[k]:
                low[k], high[k] = model.actuator_ctrlrange[k]
        kind, act = mujoco.mjtDyn(model.actuator_dyntype[number]), model.nu + int(model.actuator_actadr[number])
        count = int(model.actuator_actnum[number])
        if kind == mujoco.mjtDyn.mjDYN_MUSCLE:
            low[own], high[own] = np.clip(low[own], 0, 1), np.clip(high[own], 0, 1)
        if count and model.actuator_actlimited[number]:
            low[act : act + count], high[act : act + count] = model.actuator_actrange[number]
        if kind in _INTEGRALS:
            limit, slew = _INTEGRALS[kind]
            gain = model.actuator_gainprm[number, 0 if kind == mujoco.mjtDyn.mjDYN_PID else 5]
            if gain and (most := model.actuator_dynprm[number, limit]) > 0:
                place = act + int(model.actuator_dynprm[number, slew] > 0)
                low[place], high[place] = -most, most
    return low, high


class Rest:
    """What is not at rest in a model by `mj_forward`, as a function of controls and activations."""

    def __init__(self, model: mujoco.MjModel, qpos: np.ndarray) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        self.data.qpos[:] = qpos
        self.low, self.high = bounds(model)

    def forces(self, z: np.ndarray) -> np.ndarray:
        """The forces (nv,) that accelerate the joints, in N or N m."""
        model, data = self.model, self.data
        data.ctrl[:], data.act[:], data.qvel[:], data.qacc_warmstart[:] = z[: model.nu], z[model.nu :], 0, 0
        mujoco.mj_forward(model, data)
        found = np.zeros(model.nv)
        mujoco.mj_mulM(model, data, found, data.qacc)
        return found

    def rates(self) -> np.ndarray:
        """The change of activations (na,) in a second, by the next step."""
        model, data = self.model, self.data
        ahead = data.act + model.opt.timestep * data.act_dot
        for number in np.flatnonzero(model.actuator_actlimited):
            first = int(model.actuator_actadr[number])
            own = slice(first, first + int(model.actuator_actnum[number]) if first >= 0 else first)
            ahead[own] = np.clip(ahead[own], *model.actuator_actrange[number])
        return (ahead - data.act) / model.opt.timestep

    def left(self, z: np.ndarray) -> np.ndarray:
        """Forces and rates, (nv + na,)."""
        forces = self.forces(z)
        return np.concatenate([forces, self.rates()])

    def moving(self) -> np.ndarray:
        """Controls and activations (nu + na,) without those that nothing moves at rest.

        These stay 0: the deflection of bristles, and activations of users without a function.
        """
        model, moves = self.model, np.ones(self.model.nu + self.model.na, dtype=bool)
        for number in range(model.nactuator):
            kind, prm = mujoco.mjtDyn(model.actuator_dyntype[number]), model.actuator_dynprm[number]
            place = model.nu + int(model.actuator_actadr[number])
            if kind == mujoco.mjtDyn.mjDYN_USER:
                moves[place] = False
            elif kind == mujoco.mjtDyn.mjDYN_DCMOTOR and prm[5] > 0:  # bristles come after target, integral and warmth
                moves[place + int(prm[7] > 0) + int(model.actuator_gainprm[number, 5] != 0) + int(prm[2] > 0)] = False
        return np.flatnonzero(moves)

    def search(self, rng: Generator) -> tuple[np.ndarray | None, float]:
        """Where it rests within the ranges, by SciPy from several starts, or None; and the norm of the least forces."""
        free, least = self.moving(), np.inf
        low, high = self.low[free], self.high[free]
        whole = np.clip(np.zeros(len(self.low)), self.low, self.high)
        if not len(free):
            left = self.left(whole)
            return (whole, 0.0) if np.abs(left).max() < _REST else (None, float(np.linalg.norm(left)))

        def off(z: np.ndarray) -> np.ndarray:
            whole[free] = z
            return self.left(whole)

        for k in range(_TRIES):
            start = (
                whole[free] if k == 0 else np.clip(rng.normal(size=len(free)) * 10 ** rng.uniform(-2, 1.5), low, high)
            )
            if k == 1:
                start = np.clip(np.repeat(self.data.qpos[:1], len(free)), low, high)
            wide = np.where(high - low < 1e-9, low + 1e-9, high)  # SciPy refuses what is fixed
            start = np.clip(start, low + np.minimum(1e-6, (wide - low) / 3), wide - np.minimum(1e-6, (wide - low) / 3))
            found = least_squares(
                off, start, bounds=(low, wide), xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac", max_nfev=100
            )
            left = off(found.x)
            nv = self.model.nv
            if np.abs(left).max() < _REST * (1 + np.abs(self.data.qfrc_bias).max()):
                return whole.copy(), 0.0
            if np.abs(left[nv:]).max(initial=0.0) < 1e-6:
                least = min(least, float(np.linalg.norm(left[:nv])))
        return None, least
