"""A robot from any MJCF: its dynamics are MuJoCo's own steps, and nothing is derived by hand."""

import logging
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from lqrsim.annotations import Finite, NonNegative, OneOf, checked
from lqrsim.errors import (
    Array,
    InputError,
    check_array,
    check_items,
    check_name,
    check_number,
    check_weight_vector,
    excerpt,
    listed,
    renamed,
    vectors_of,
)
from lqrsim.problem.collision_shape import CollisionGeoms, MjcfBalls, ShapeInWorld
from lqrsim.problem.control_rate import ControlRate
from lqrsim.problem.force_limits import ForceLimit, ForceLimits, limited_forces
from lqrsim.problem.mjcf_dynamics import MjcfDynamics
from lqrsim.problem.obstacles import Clearance, ObstacleCost, SelfClearance
from lqrsim.problem.parts import Constraint, Cost
from lqrsim.problem.problem import FixedState, Problem
from lqrsim.problem.quadratic_cost import ControlCost, QuadraticCost
from lqrsim.problem.state_bounds import LimitCost, StateBounds
from lqrsim.results.coordinates import Coordinates, PerEntry
from lqrsim.robots.base import Robot, configuration_of
from lqrsim.rotations import AXES
from lqrsim.scenes.mjcf_holding import Holding, at_rest, falling, holding
from lqrsim.scenes.mjcf_kinematics import Equalities, contacts_of, leaders_of, reach_of
from lqrsim.scenes.mjcf_model import FAR_PAST, MjcfModel
from lqrsim.scenes.mujoco_log import mujoco
from lqrsim.scenes.scene import (
    Choice,
    Scene,
    chosen_geoms,
    in_the_way,
    mounting_pairs,
    obstacle_geoms,
    scene_of,
    solid_geoms,
)
from lqrsim.scenes.world import World

_log = logging.getLogger("lqrsim")

_SHARPNESS, _CONTACT_COST = 20.0, 0.1  # of ObstacleCost, in 1/m; weight: cost of a contact, 20 % of it at 8 cm
_LIMIT_MARGIN = 0.1, 0.05  # rad or m, and fraction of the range: plans keep from limits the smaller of both
_PAST = 1e-3  # fraction of a joint's range that a goal may be past its limits
_REST = 1e-6  # m/s^2, largest acceleration at rest
_PERIOD = 0.02  # s, control period, rounded to a whole number of physics steps
_UNSTABLE = 2.0  # factor by which a deviation grows in a period where MuJoCo's steps are unstable; robots fall slower


class MjcfRobot(Robot):
    """Everything that moves in an MJCF, as one robot.

    A cart-pole, from hanging to standing:

        robot = ls.MjcfRobot("cartpole.xml")
        solution = ls.smooth(robot.problem(robot.at(pole=np.pi), robot.at()))
        rollout = ls.simulate(ls.Plant(robot, robot.scene), solution)

    The states are the positions of the joints in MuJoCo's order, then their velocities, then the states of actuators.
    Slides and hinges have the joint's name and `<name>_velocity`; ball joints `<name>_rx` to `_rz`, a rotation vector,
    and `<name>_wx` to `_wz` in body axes; free joints also `<name>_x` to `_z` and `<name>_vx` to `_vz`, without the
    `<name>_` if the joint has no name. States of actuators are `<name>_activation`. A hinge without limits is an
    angle. The controls are MuJoCo's `ctrl`, limited by ctrlrange, by the actuators' names; those of an actuator with
    several are `<actuator>_pos` and `<actuator>_vel`, by MuJoCo's names of its inputs. Elements without a name in the
    MJCF get a name, such as `unnamed_joint_0`; of several free joints without one, each gets its body's.

    If the file has no light, one is added. Without a camera named overview, pictures show the whole run.

    Obstacles are the geoms that are fixed to the world and can touch the robot, except its own base, which carries it,
    and what it stands on and moves over. They do not collide in the plan's physics: costs and constraints keep clear of
    them, at MuJoCo's distances, as `ls.Clearance(robot.scene.world, geoms=robot.geoms)`. A pedestal that a link turns
    on is no obstacle for that link: they touch in every position of the joints. All other contacts are MuJoCo's.

    Args:
      file: the name of a packaged scene, the path of an MJCF or of a URDF, or a Scene; see `load_scene`.
      body: name of the body on which disturbances act, and whose position is the robot's. By default the first moving
        body that has mass, its own mass or the mass of bodies fixed to it.
      position: the 2 or 3 states that are the body's position in the world, in metres; by default found by MuJoCo's
        kinematics. () for none.
      radius: radius of a ball about the body's origin that contains everything that may collide; by default of one that
        does so at any angles of the joints, with slides at rest.
      outline: whether the robot gets `balls`, fixed to its bodies, that cover the colliding geoms; by default only if
        it has no position. A sphere gets one ball, a capsule a chain of balls, any other geom its bounding ball. The
        balls are cheap bounds of the colliding geoms, and pictures follow them.
      floors: whether there is ground for standing on: level planes and height fields, if a joint lets the robot sink to
        them, and all geoms on which it stands and that a free joint or a slide moves it over.
      obstacles: others than by default, as for `load_scene`. Other geoms collide through MuJoCo's contacts, in the
        plan, too.
      turns_about: whether free and ball joints turn about this axis on and on: of the world, or of a ball's
        parent body. The entry along it, such as `<name>_rz`, is then a turn about it, however many times, after a tilt,
        the rotation vector of the other two. Only a tilt of half a turn is singular, as upside down. By default all
        three are a rotation vector, which is singular at whole turns.
      mocap: the keyframe whose mpos and mquat place the mocap bodies, in plans and runs; by default they stay where the
        MJCF has them. In a plan they do not move.

    Attributes:
      mjcf: its MJCF, with joints and actuators; `mjcf.model` is MuJoCo's model of it, as runs have it. That of plans is
        `dynamics.physics.model`.
      scene: the scene that the robot moves in.
    """

    @checked
    def __init__(
        self,
        file: str | os.PathLike[str] | Scene,
        *,
        body: str | None = None,
        position: Sequence[str] | None = None,
        radius: NonNegative | None = None,
        outline: bool | None = None,
        floors: bool = True,
        obstacles: Choice = True,
        turns_about: Annotated[str, OneOf(AXES)] | None = None,
        mocap: str | None = None,
    ) -> None:
        mjcf = file.mjcf if isinstance(file, Scene) else MjcfModel.of_file(file)
        self.name, who = mjcf.name, f"MjcfRobot {mjcf.name}"
        self.mjcf = mjcf = mjcf.for_robot(turns_about, mocap, who)
        model, number = mjcf.model, mjcf.body_of(body, who)
        candidates = list(file.geoms) if isinstance(file, Scene) else obstacle_geoms(model)
        every = obstacles is True
        geoms = in_the_way(model, candidates, number, floors=floors) if every else chosen_geoms(model, obstacles, who)
        self._candidates = candidates if floors and every else []
        self.scene = scene_of(mjcf, geoms)
        self._arguments: dict[str, Any] = {
            "body": body, "position": position, "radius": radius, "outline": outline, "floors": floors,
            "turns_about": turns_about,
            "obstacles": obstacles if isinstance(obstacles, bool) else self.scene.world.names,
        }  # fmt: skip
        self.body = model.body(number).name
        self.joints = tuple(joint.name for joint in mjcf.joints)
        self.actuators = tuple(actuator.name for actuator in mjcf.actuators)
        self.activations = len(mjcf.activations)
        names, units = zip(*mjcf.states, strict=True)
        starts = {"free": 3, "ball": 0}  # index among a joint's coordinates at which its rotation vector begins
        rotations = tuple(joint.dof + starts[joint.kind] for joint in mjcf.joints if joint.kind in starts)
        if turns_about is not None and not rotations:
            raise InputError(f"{who}: turns_about: got {turns_about!r} without a free or ball joint, want None")
        turns = [] if turns_about is None else [first + AXES.index(turns_about) for first in rotations]
        dofs, plane = self._position(number, position, names, who)
        limits = {joint.dof: joint.limits for joint in mjcf.joints if joint.limits is not None}
        low, high = zip(*(limits.get(i, (-np.inf, np.inf)) for i in range(len(names))), strict=True)
        states = Coordinates(
            names=names, units=units, position=dofs, plane=plane, low=low, high=high, rotation_vectors=rotations,
            angles=(*(joint.dof for joint in mjcf.joints if joint.kind == "hinge" and joint.limits is None), *turns),
        )  # fmt: skip
        self._dynamics = MjcfDynamics(mjcf, who, body=number, obstacles=tuple(geoms), states=states)
        self.radius = reach_of(model, number) if radius is None else radius

    @cached_property
    def balls(self) -> MjcfBalls | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        outline, model = self._arguments["outline"], self.mjcf.model
        by_default = not self.dynamics.state_coordinates.position and len(solid_geoms(model)) > 0
        return MjcfBalls(model) if (by_default if outline is None else outline) else None

    @cached_property
    def geoms(self) -> CollisionGeoms:  # pyright: ignore[reportIncompatibleVariableOverride]
        return CollisionGeoms(self.scene)

    @checked
    def among(self, world: World) -> ShapeInWorld:
        """The geoms among other obstacles than those of the scene, in a copy of the MJCF that has them."""
        if not len(world):
            return self.geoms.in_world(self.dynamics, world)
        copy = Scene(self.mjcf.with_obstacles(world), World(), ())
        other = MjcfRobot(copy, **{**self._arguments, "obstacles": world.names})
        # Their places in the compiled model, which differ in the last bits.
        pairs = zip(other.scene.world.obstacles, world.obstacles, strict=True)
        moved = World([replace(compiled, velocity=obstacle.velocity) for compiled, obstacle in pairs])
        return other.geoms.in_world(other.dynamics, moved)

    def _position(
        self, body: int, asked: Sequence[str] | None, names: tuple[str, ...], who: str
    ) -> tuple[tuple[int, ...], str]:
        """The states that are the body's position, as asked or by default, and their plane; both empty for none."""
        self._axes, moving = _axes_of(self.mjcf, body)
        axes = {dof: axis for dof, (axis, offset) in self._axes.items() if not offset}
        if asked is None:
            dofs = sorted(axes, key=lambda dof: axes[dof])
            # A plane is a position only if nothing moves the body out of it.
            if len(set(axes.values())) < len(dofs) or len(dofs) < max(moving, 2):
                return (), ""
        else:
            listed = check_items(f"{who}: position", asked, str, "a tuple of 2 or 3 names of states, or ()")
            dofs = [names.index(check_name(f"{who}: position", name, names)) for name in listed]
        plane = "".join(AXES[axes[dof]] for dof in dofs if dof in axes)
        if dofs and (len(plane) != len(dofs) or len(set(plane)) < len(plane)):
            got, among = excerpt(tuple(asked or ())), ", ".join(names[dof] for dof in axes) or "none"
            raise InputError(
                f"{who}: position: got {got}, want 2 or 3 that are the position of the body {self.body!r},"
                f" among: {among}" + "".join(f"; {line}" for line in self._shifted(names))
            )
        return tuple(dofs), plane if len(dofs) == 2 else ""

    def _shifted(self, names: tuple[str, ...]) -> list[str]:
        """Of each slide that moves the body along an axis, but from another zero: what makes it part of a position."""
        return [
            f"{names[dof]} is the body's {AXES[axis]} minus {offset:.6g} m, and would be its {AXES[axis]}"
            f' with ref="{offset:.6g}" in the <joint>'
            for dof, (axis, offset) in self._axes.items()
            if offset
        ]

    @property
    def dynamics(self) -> MjcfDynamics:
        return self._dynamics

    @cached_property
    def _forces(self) -> tuple[tuple[ForceLimit, ...], tuple[str, ...]]:
        return limited_forces(self.mjcf)

    @property
    def force_limits(self) -> ForceLimits:
        """The limits of forces as constraints, for a problem with `unlimited` as its dynamics; see `ForceLimits`.

        They are those of `forcerange` and `actuatorfrcrange` where the force is linear, as of motors and servos.
        """
        if not self._forces[0]:
            raise InputError(f"MjcfRobot {self.name}: force_limits: got none that are linear, want problems without")
        return ForceLimits(self._forces[0])

    @cached_property
    def unlimited(self) -> MjcfDynamics:
        """The dynamics without these limits."""
        return self.force_limits.removed_from(self.dynamics)

    def self_clearance(self, margin: float = 0.0) -> SelfClearance:
        """The constraint that links which MuJoCo lets collide are some metres apart, at the steps of a plan.

        MuJoCo does not let bodies collide that are fixed to each other, parent and child, or in an `<exclude>` of the
        MJCF. Links that touch in every position are left out, and so is what the robot handles.
        """
        constraint = SelfClearance(self.mjcf, self.body, margin)
        if not constraint.links:
            want = "want an MJCF that lets two links collide"
            raise InputError(f"MjcfRobot {self.name}: self_clearance: got no pair of links that can collide, {want}")
        return constraint

    def with_parameters(self, **values: float) -> "MjcfRobot":
        """The robot with other numbers in its MJCF, for plans and plants: `robot.with_parameters(mass=0.6)`.

        `dynamics.numbers` has the names and values. `dynamics.with_parameters` changes the numbers for a plan alone.
        """
        changed = self.dynamics.with_parameters(**values)
        return MjcfRobot(scene_of(changed.mjcf, self.scene.geoms), **self._arguments)

    def hold(self, state: npt.ArrayLike) -> Array:
        """The controls (m,) that hold the robot still, by MuJoCo's own forces: torques, or the targets of servos.

        They are the smallest that hold within the limits of controls, activations and forces. If none hold the robot,
        those with the least sum of squared remaining forces nearby; `print(robot)` says what is missing at rest, and
        which activations never rest. Velocities and activations of the state do not count.
        """
        return self._held(check_array("state", state, (len(self.dynamics.state_coordinates),))).controls

    def at_rest(self, state: npt.ArrayLike) -> Array:
        """A state (n,) near another in which the robot stands at rest; `hold` has the controls for it.

        Joints without actuators, such as a free base, move to it. Legs keep their angles. The base moves to where the
        contacts, which are springs, carry it. A base that touches nothing is let down first. Activations of actuators
        take the values that hold it.
        """
        state = check_array("state", state, (len(self.dynamics.state_coordinates),))
        model = self.dynamics.physics.model
        qpos, residual = at_rest(self.mjcf, model, self.configuration(state)[0])
        if residual > _REST * float(model.body_mass.sum()):
            names = self.scene.world.names
            hint = f"; obstacles such as {names[0]} carry nothing: obstacles= chooses others" if names else ""
            touching = [pair for pair in contacts_of(model, self.configuration(state)[0]) if "world" not in pair]
            if touching:  # by construction: their contact pushes them apart, and nothing is at rest
                hint = f"; {' and '.join(touching[0])} touch, which an <exclude> in the <contact> section allows"
            raise InputError(
                f"state: got no state of rest nearby: {residual:.3g} N or N m are left, want a state in which the"
                f" robot touches its support, or is above it{hint}"
            )
        rested = state.copy()
        rested[: 2 * model.nv] = self.state(qpos, np.zeros(model.nv), near=state)
        held = self._held(rested)
        for drifting in self._drifting(held)[:1]:
            raise InputError(f"state: got one at which {drifting}, want activations that come to rest")
        rested[2 * model.nv :] = held.activations
        return rested

    settled = renamed("settled", "at_rest")

    def _drifting(self, held: Holding) -> list[str]:
        """Why each actuator that never rests does not, as text."""
        reasons = list[str]()
        for number in np.flatnonzero(held.drifting).tolist():
            actuator = self.mjcf.actuators[number]
            controls = list(zip(self.mjcf.controls[actuator.controls], held.controls[actuator.controls], strict=True))
            ends = [(control, "least", control.low) for control, value in controls if value <= control.low]
            ends += [(control, "most", control.high) for control, value in controls if value >= control.high]
            subject = "its control" if len(controls) == 1 else "{}"
            cause = "".join(f": {subject.format(control.name)} is at {end} {side:g}" for control, end, side in ends[:1])
            reasons.append(f"the activation of {actuator.name} drifts{cause}")
        return reasons

    def _held(self, state: Array) -> Holding:
        return holding(self.mjcf, self.dynamics.physics.model, self.configuration(state)[0])

    @checked
    def problem(
        self,
        start: npt.ArrayLike,
        goal: npt.ArrayLike,
        *,
        steps: int = 150,
        dt: float | None = None,
        weights: PerEntry = 100.0,
        effort: PerEntry | None = None,
        damping: NonNegative = 1e-3,
        attitude: NonNegative = 0.1,
        limits: NonNegative = 100.0,
        clearance: Finite | None = None,
        self_clearance: Finite | None = None,
        force_limits: bool = True,
        control_rate: ControlRate | None = None,
    ) -> Problem:
        """Make a problem: from one state to another, within the actuators' limits, with costs on obstacles.

        Joint limits have a cost, too. MuJoCo's step is discontinuous where a limit is just reached, and plans that move
        along a limit do not converge.

        The control cost is zero at the controls that hold the robot still at the start. If it can also be held at the
        goal, the cost is zero at the mean of both. Solvers start from these controls.

        Args:
          dt: the control period in seconds; by default about 0.02.
          weights: weights of the final error: one number for all states, (n,), or by name or unit, {"m": 100}; states
            that are not named then have none. The turn of a wheel (`MjcfModel.wheels`) has none unless it is named or
            (n,) are given, or the goal turns it.
          effort: weights of the controls, in the same form. By default 1 over the square of a control's largest value,
            so that a deviation of that size costs 1/2. The largest value comes from the control limits, else from the
            force limits, else it is 1.
          attitude: if the robot's body moves on a free joint, the weight of its attitude, about the goal's, at each
            step; half of it is that of its angular velocity. With 0, nothing keeps a plan from tumbling on its way.
          limits: weight of joint limits at each step. The cost of a limit begins at the least of these distances from
            it: 0.1 rad or m, 5 % of the joint's range, and the distances at start and goal.
          clearance: least distance to all obstacles in metres, as a constraint; by default obstacles only add cost.
          self_clearance: margin of the constraint `self_clearance`; by default links may touch, as MuJoCo has it.
          force_limits: whether limits of forces are constraints, as in `force_limits`, and not in the dynamics. Those
            that no control keeps at the start stay in the dynamics, as all do if MuJoCo's steps are unstable without
            them, or with False: then forces may saturate.
          control_rate: cost and limits of the rates of controls; see `Problem`.
        """
        dynamics, model = self.dynamics, self.mjcf.model
        n, controls = len(dynamics.state_coordinates), dynamics.control_coordinates
        start, goal = check_array("start", start, (n,)), check_array("goal", goal, (n,))
        bounds = self._bounds(start, goal)
        at_start, at_goal = self._held(start), self._held(goal)
        about = (at_start.controls + at_goal.controls) / 2 if at_start.held and at_goal.held else at_start.controls
        effort = self.mjcf.efforts**-2.0 if effort is None else effort
        of_controls = effort if isinstance(effort, Mapping) else check_weight_vector("effort", effort, len(controls))
        cost: Cost = ControlCost(of_controls, about=about)
        state_weights, about_state, root = np.zeros(n), np.zeros(n), model.body_rootid[dynamics.physics.body]
        for joint in self.mjcf.joints:
            if joint.kind != "free":
                state_weights[model.nv : 2 * model.nv][joint.dofs] = damping
            elif model.dof_bodyid[joint.dof] == root:  # not of something that the robot handles
                rotation = slice(joint.dof + 3, joint.dof + 6)
                state_weights[rotation], about_state[rotation] = attitude, goal[rotation]
                state_weights[model.nv : 2 * model.nv][rotation] = 0.5 * attitude
        if state_weights.any():
            cost = cost + QuadraticCost(state_weights, about=about_state)
        if limits > 0 and any(bounds):
            cost = cost + LimitCost(*bounds, weight=limits)
        period = dynamics.period_near(_PERIOD) or dynamics.period if dt is None else dt
        constraints: list[Constraint] = []
        if clearance is not None:
            self._warn_of_near(np.array([start, goal]), clearance)
            constraints.append(Clearance(self.scene.world, **self.shape, margin=clearance))
        if self_clearance is not None:
            constraints.append(constraint := self.self_clearance(self_clearance))
            constraint.check("start", dynamics, start)
            constraint.check("goal", dynamics, goal)
        kept = [limit for limit in self._forces[0] if limit.can_be_kept(start, *controls.limits)]
        if force_limits and kept:
            forces = ForceLimits(kept)
            unlimited = forces.removed_from(dynamics)
            if _is_stable(unlimited, start, at_start.controls, period):
                dynamics = unlimited
                constraints.append(forces.within(dynamics, start, at_start.controls, period))
        if len(self.scene.world):
            cost = cost + ObstacleCost(self.scene.world, geoms=self.geoms, sharpness=_SHARPNESS, weight=_CONTACT_COST)
        return Problem(
            dynamics=dynamics, dt=period, steps=steps, initial=FixedState(start), stage_cost=cost,
            final_cost=QuadraticCost(self._final_weights(weights, start, goal), about=goal), constraints=constraints,
            control_rate=control_rate,
        )  # fmt: skip

    def _warn_of_near(self, ends: Array, clearance: float) -> None:
        """Log a warning if an obstacle is nearer than a clearance both at the start and at the goal, (2, n)."""
        names = self.scene.world.names
        if not names:
            return
        nearest = self.geoms.in_world(self.dynamics, self.scene.world).clearances(ends).max(axis=0)
        for name, near in zip(names, nearest.tolist(), strict=True):
            if near < clearance:
                _log.warning(
                    "%r is %.3g m from the robot at start and goal, where a clearance of %g m is wanted: ask for less,"
                    " or give MjcfRobot other obstacles=", name, near, clearance,
                )  # fmt: skip

    def _final_weights(self, weights: PerEntry, start: Array, goal: Array) -> PerEntry:
        """Weights without those of the turns of wheels, which roll on, unless they are named or the goal turns them."""
        names = self.dynamics.state_coordinates.names
        rolling = [wheel.dof for wheel in self.mjcf.wheels if start[wheel.dof] == goal[wheel.dof]]
        if isinstance(weights, Mapping):
            return {**{names[dof]: 0.0 for dof in rolling}, **weights}
        numbers = check_weight_vector("weights", weights, len(names))
        if np.ndim(weights) == 0:
            numbers[rolling] = 0.0
        return numbers

    def _bounds(self, start: Array, goal: Array) -> tuple[dict[str, float], dict[str, float]]:
        """Least and largest positions of joints, by name: at some distance from their limits, if both states are.

        Limits are springs, and an MJCF may itself be past them at rest or in a keyframe. Raises InputError for another
        start far past them, and for a goal that moves a joint past them.
        """
        names, low, high, model = self.dynamics.state_coordinates.names, {}, {}, self.mjcf.model
        for joint in self.mjcf.joints:
            if joint.limits is None:
                continue
            begin, end = start[joint.dof], goal[joint.dof]
            positions = [model.qpos0[joint.qpos.start], *model.key_qpos[:, joint.qpos.start]]
            of_mjcf = np.isclose(begin, positions, rtol=0, atol=1e-9).any()
            if not of_mjcf and (complaint := joint.past_limits(begin, FAR_PAST)):
                raise InputError(f"start: {complaint}")
            if end != begin and (complaint := joint.past_limits(end, _PAST)):
                raise InputError(f"goal: {complaint}")
            least, most = joint.limits
            margin = min(_LIMIT_MARGIN[0], _LIMIT_MARGIN[1] * (most - least))
            low[names[joint.dof]] = max(least, min(least + margin, begin, end))
            high[names[joint.dof]] = min(most, max(most - margin, begin, end))
        return low, high

    def __str__(self) -> str:
        space, controls = self.dynamics.state_coordinates, self.dynamics.control_coordinates
        held = self._held(self.at())
        commands = [f"{name} {value:.4g}" for name, value in zip(controls.names, held.controls, strict=True)]
        worst = int(np.argmax(np.abs(held.missed)))
        unit = "N m" if space.units[worst] == "rad" else "N"
        shortfall = "".join(f"; {drifting}" for drifting in self._drifting(held))
        if not held.held and not shortfall:
            shortfall = f"; {space.names[worst]} is not held: {abs(held.missed[worst]):.3g} {unit} are missing"
            model, driven = self.dynamics.physics.model, {actuator.joint for actuator in self.mjcf.actuators}
            falls = falling(model, self.configuration(self.at())[0])
            if model.dof_jntid[worst] in falls and self.mjcf.joints[model.dof_jntid[worst]].name not in driven:
                shortfall += "; what stands on the ground starts from robot.at_rest(robot.at())"
                shortfall += ", on the command line with at_rest=True"
        position = ", ".join(space.names[i] for i in space.position)
        where = f"with the position {position}" if position else "whose position is not among the states"
        lines = [
            f"{self.name}: {len(space)} states, {len(controls)} controls, steps of {self.mjcf.model.opt.timestep:g} s",
            f"  states: {listed(space.names)}",
            f"  body: {self.body}, {where}",
            *(f"    {line}" for line in ([] if space.position else self._shifted(space.names))),
            f"  held at rest by: {listed(commands)}{shortfall}",
            *(f"  {title}: {listed(entries)}" for title, entries in self._remarks().items() if entries),
        ]
        return "\n".join(lines)

    def _remarks(self) -> dict[str, list[str]]:
        """What a plan does about forces and speeds, what is amiss at the MJCF's rest, and obstacles, by title."""
        model, rest_state, names = self.dynamics.physics.model, self.at(), self.dynamics.state_coordinates.names
        space, joints, (limits, clipped) = self.dynamics.state_coordinates, self.mjcf.joints, self._forces
        losses = zip(space.names, space.units, model.dof_frictionloss.tolist(), strict=False)
        tendons = ((model.tendon(i).name, "m", loss) for i, loss in enumerate(model.tendon_frictionloss.tolist()))
        units, obstacle_of = {"rad": "N m", "m": "N"}, dict(zip(self.scene.geoms, self.scene.world.names, strict=True))
        past = [
            f"{names[joint.dof]} {rest_state[joint.dof]:.4g} (want {joint.limits[0]:.4g} to {joint.limits[1]:.4g})"
            for joint in joints
            if joint.limits is not None and not joint.limits[0] <= rest_state[joint.dof] <= joint.limits[1]
        ]
        without_floors = in_the_way(self.mjcf.model, self._candidates, self.dynamics.physics.body, floors=False)
        mounts = [
            f"{obstacle_of[obstacle]} ({self.mjcf.model.body(int(self.mjcf.model.geom_bodyid[mount])).name})"
            for mount, obstacle in mounting_pairs(self.mjcf.model, list(self.scene.geoms)).tolist()
        ]
        return {
            "force limits, constraints of plans": [
                f"{limit.name.partition(' ')[2]} {limit.low:.4g} to {limit.high:.4g} {limit.unit}" for limit in limits
            ],
            "force limits, clipped in plans as in runs": [name.partition(" ")[2] for name in clipped],
            "dry friction, in plans and runs": [
                f"{name} {loss:.4g} {units[unit]}" for name, unit, loss in (*losses, *tendons) if loss > 0
            ],
            "limits of speed, kept only by robot.joint_limits": [
                f"{joint.name} {joint.speed:.4g} {'m' if joint.kind == 'slide' else 'rad'}/s"
                for joint in joints
                if np.isfinite(joint.speed)
            ],
            "past their limits at rest": past,
            "touching at rest": [" and ".join(pair) for pair in contacts_of(model, self.configuration(rest_state)[0])],
            "obstacles": list(self.scene.world.names) or ["none"],
            "ground, which is no obstacle": [
                model.geom(geom).name for geom in without_floors if geom not in self.scene.geoms
            ],
            "carried, without contacts, by": list(dict.fromkeys(mounts)),
        }

    @property
    def joint_limits(self) -> StateBounds:
        """The joints' ranges as constraints for a problem, and their largest speeds, where they are stated.

        In MuJoCo, limits of joints are springs that push back. It knows none of speeds, which are in a URDF, or in the
        <custom> section of an MJCF: `<numeric name="JOINT_velocity_limit" data="2"/>`.
        """
        names, nv = self.dynamics.state_coordinates.names, self.mjcf.model.nv
        places = {names[joint.dof]: joint.limits for joint in self.mjcf.joints if joint.limits is not None}
        limited = [joint for joint in self.mjcf.joints if np.isfinite(joint.speed)]
        speeds = {names[nv + joint.dof]: (-joint.speed, joint.speed) for joint in limited}
        if not (bounds := places | speeds):
            raise InputError(f"MjcfRobot {self.name}: joint_limits: got none, want problems without")
        return StateBounds(bounds)

    def at(self, keyframe: str | None = None, **values: float) -> Array:
        """A state (n,) at rest as in the MJCF, or in one of its keyframes, except for the named states.

        A joint that an equality constraint couples to another follows it; if it is named, the other moves. The joints
        of a closed loop begin at the MJCF's rest, or the keyframe, and move as little as they must. Activations are
        those that hold the robot, unless they are named or the keyframe has an `act`; its `ctrl` does not count.
        """
        model, who = self.mjcf.model, f"MjcfRobot {self.name}"
        state = np.zeros(len(self.dynamics.state_coordinates))
        if keyframe is None:
            qpos, qvel, act = model.qpos0.copy(), np.zeros(model.nv), None
        else:
            qpos, qvel, act = self.mjcf.keyframe(keyframe, who)
        state[: 2 * model.nv], state[2 * model.nv :] = self.state(qpos, qvel), 0.0 if act is None else act
        names = self.dynamics.state_coordinates.names
        for name, value in values.items():
            state[names.index(check_name(f"{who}: state", name, names))] = check_number(f"{who}: {name}", value)
        if (keyframe is None or values) and model.eq_active0.any():
            state[: model.nv] = self._closed(state, qpos, values)
        if self.activations and act is None:
            unnamed = [i for i in range(2 * model.nv, len(names)) if names[i] not in values]
            state[unnamed] = self._held(state).activations[np.array(unnamed, dtype=np.intp) - 2 * model.nv]
        return state

    def _closed(self, state: Array, qpos: Array, named: Iterable[str]) -> Array:
        """The positions (nv,) of a state that meet equalities and are as named, beginning with qpos (nq,)."""
        model, names = self.mjcf.model, self.dynamics.state_coordinates.names
        fixed = np.zeros(model.nv, dtype=bool)
        for joint in self.mjcf.joints:
            fixed[joint.dofs] = not set(names[joint.dofs]).isdisjoint(named)
        equalities, aim = Equalities(model), self.configuration(state)[0]
        # Followers follow; what they follow moves only if one of them is named.
        tries = (equalities.met(qpos, aim, dofs) for dofs in (fixed | leaders_of(model), fixed))
        place = next((place for place in tries if place is not None), None)
        if place is None:
            got = ", ".join(f"{names[dof]} {state[dof]:g}" for dof in np.flatnonzero(fixed)) or "none of them named"
            raise InputError(
                f"MjcfRobot {self.name}: joints: got {got}, want positions at which all loops close and followers are"
                " where their equalities have them"
            )
        closed = self.state(place, np.zeros(model.nv))[: model.nv]
        closed[fixed] = state[: model.nv][fixed]  # to the last bit
        return closed

    def with_closed_loops(self, states: npt.ArrayLike) -> Array:
        """The nearest states (..., n) at which all equality constraints are met, in positions and in velocities."""
        model = self.mjcf.model
        states = vectors_of("states", states, len(self.dynamics.state_coordinates))
        if not model.eq_active0.any():
            return states
        equalities, corrected = Equalities(model), states.copy()
        for state in corrected.reshape(-1, states.shape[-1]):
            closed = equalities.closed(*self.configuration(state))
            if closed is None:
                names, positions = self.dynamics.state_coordinates.names, state[: model.nv].tolist()
                got = listed([f"{name} {value:.4g}" for name, value in zip(names, positions, strict=False)])
                raise InputError(f"MjcfRobot {self.name}: states: got {got}, want positions near which all loops close")
            state[: 2 * model.nv] = self.state(*closed, near=state)
        return corrected

    def state(self, qpos: npt.ArrayLike, qvel: npt.ArrayLike, near: npt.ArrayLike | None = None) -> Array:
        model = self.mjcf.model
        qpos, qvel = configuration_of(qpos, qvel, model.nq, model.nv)
        state = np.concatenate([self.mjcf.positions_of(qpos), qvel], axis=-1)
        if near is None:
            return state
        near = vectors_of("near", near, len(self.dynamics.state_coordinates))
        unknown = np.zeros((*state.shape[:-1], self.activations))
        nearest = self.dynamics.state_coordinates.nearest(np.concatenate([state, unknown], axis=-1), near)
        return nearest[..., : 2 * model.nv]

    def configuration(self, state: npt.ArrayLike) -> tuple[Array, Array]:
        state, nv = vectors_of("state", state, len(self.dynamics.state_coordinates)), self.mjcf.model.nv
        return self.mjcf.qpos_of(state[..., :nv]), state[..., nv : 2 * nv].copy()


def _is_stable(dynamics: MjcfDynamics, state: Array, control: Array, dt: float) -> bool:
    """Whether no deviation from a state grows by `_UNSTABLE` in a period: explicit steps of stiff servos may."""
    try:
        motion = dynamics.linearize(state, control, dt)[0]
    except InputError:  # beyond all numbers
        return False
    return bool(np.isfinite(motion).all()) and float(np.abs(np.linalg.eigvals(motion)).max()) < _UNSTABLE


def _axes_of(mjcf: MjcfModel, body: int) -> tuple[dict[int, tuple[int, float]], int]:
    """The degrees of freedom that alone move a body's origin along an axis of the world, found by moving all joints.

    Each with the axis, and the origin's coordinate there at its zero; and the number of axes along which it moves.
    """
    model, data, rng = mjcf.model, mujoco.MjData(mjcf.model), np.random.default_rng(0)
    candidates = {
        joint.dof + i: joint.qpos.start + i for joint in mjcf.joints if joint.kind in ("free", "slide")
        for i in range(3 if joint.kind == "free" else 1)
    }  # fmt: skip
    origins, positions = np.zeros((5, 3)), np.zeros((5, model.nq))
    for trial in range(5):
        data.qpos[:] = model.qpos0 + rng.normal(size=model.nq)
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_kinematics(model, data)
        origins[trial], positions[trial] = data.xpos[body], data.qpos
    axes = dict[int, tuple[int, float]]()
    for dof, number in candidates.items():
        for axis in range(3):
            offset = origins[:, axis] - positions[:, number]
            if np.ptp(offset) < 1e-9:
                axes[dof] = axis, 0.0 if np.abs(offset).max() < 1e-9 else float(offset.mean())
    return axes, int((np.ptp(origins, axis=0) > 1e-9).sum())
