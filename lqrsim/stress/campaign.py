"""Running a campaign: trials of policies under disturbances of growing strength, stored in a folder.

    campaign = Campaign(scenario="quadrotor", sweeps={"gusts": (ls.disturbances.ForceNoise(0.2),)})
    results = run_campaign(campaign, "runs/stress/quadrotor")

A campaign can be interrupted at any time. On equal processors the rows of a trial depend on the campaign alone, not on
the number of workers, the batch size or interruptions.
"""

import contextlib
import errno
import itertools
import logging
import os
import sys
from collections.abc import Iterator
from copy import copy
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from lqrsim.annotations import Bounds, Progress, Want, checked
from lqrsim.errors import InputError, check_path, excerpt, free_name, without_addresses
from lqrsim.machine import changed, description, other_lqrsim, processors, versions
from lqrsim.results import save_load
from lqrsim.results.archive import sha256
from lqrsim.results.solution_parts import Trajectory
from lqrsim.scenarios import solutions as solving
from lqrsim.scenarios.packaged import Scenario
from lqrsim.simulation.disturbances import Disturbance
from lqrsim.stress import executors, policies
from lqrsim.stress.results import (
    MANIFEST,
    SOLUTION_FILE,
    Damaged,
    Results,
    read_manifest,
    read_table,
    write,
    write_manifest,
)
from lqrsim.stress.study import Campaign, Shard, Trials

_log = logging.getLogger("lqrsim")

MOST_WORKERS, LARGEST_BATCH = 1024, 100_000
_HELD = {errno.EACCES, errno.EAGAIN, errno.EDEADLK}  # another process has the lock; EDEADLK on Windows
_CAMPAIGN_FILES = {MANIFEST, SOLUTION_FILE, "campaign.lock", "policies", "shards", "damaged"}


@checked
def run_campaign(
    campaign: Campaign,
    folder: str | os.PathLike[str],
    *,
    workers: Annotated[int, Bounds(at_least=0, at_most=MOST_WORKERS)] | None = None,
    batch: Annotated[int, Bounds(at_least=1, at_most=LARGEST_BATCH)] = 256,
    scheduler: Annotated[str, Want("an address, such as tcp://host:8786")] | None = None,
    progress: Progress | None = None,
) -> Results:
    """Run the trials of a campaign that are not in its folder yet. Call it again to resume after an interruption.

    Args:
      folder: where everything is stored, the campaign's `solution` too.
      workers: number of processes on this machine; by default one per processor. 0 runs everything in this process.
      batch: number of trials that a worker simulates together; affects only time and memory.
      scheduler: address of a dask cluster that does the work instead of this machine, such as tcp://10.0.0.1:8786.

    Raises:
      InputError: a script calls this with workers and without `if __name__ == "__main__":`, so that each worker would
        call it again.
    """
    executors.end_if_started_by_import()
    # A copy, so that the next run resolves the scenario again: its code may have changed.
    campaign, folder = copy(campaign), check_path("folder", folder, "the path of a folder")
    workers = processors() if workers is None else workers
    tell = progress or (lambda done, total: None)
    deterministic = _check_runnable(campaign)
    if os.path.isdir(folder) and not os.path.exists(folder / MANIFEST):
        names = (name for name in os.listdir(folder) if not name.startswith(".unfinished-"))
        if others := sorted({*names} - _CAMPAIGN_FILES):
            raise InputError(f"folder: got {folder}, which has {excerpt(others)}, want an empty folder or a campaign's")
    with contextlib.ExitStack() as stack:
        client = None if scheduler is None else stack.enter_context(executors.connected(scheduler))
        stack.enter_context(_sole_writer(folder))
        stack.enter_context(_resumable(folder, campaign.scenario))
        specification = _specification(campaign) | {"deterministic": deterministic}
        if os.path.exists(folder / MANIFEST):
            _check_same_campaign(specification, read_manifest(folder), folder)
        else:
            _begin(campaign, specification, folder)
        results = Results(folder, scenario=campaign.scenario)
        unfinished = _unfinished(results)
        if unfinished and (others := changed(results.manifest["versions"])):
            want = f"the versions of {folder}, or another folder"
            raise InputError(f"versions: got {others}, which may change the last bits, want {want}")
        trials = Trials(campaign, {policy: results.solution(policy) for policy in campaign.policies})
        if unfinished:
            executors.warm_up(trials)  # done here first, so that the workers find everything compiled
        job = executors.Job.of(trials, results.manifest, batch)
        total = campaign.trials * len(results.cells)
        done = total - sum(shard.count for shard in unfinished)
        tell(done, total)
        if client is not None:
            work = executors.run_on_cluster(job, unfinished, client, campaign.time_limit)
        elif workers:
            work = executors.run_in_processes(job, unfinished, min(workers, len(unfinished)), campaign.time_limit)
        else:
            work = ((shard, job.work(shard, trials)) for shard in unfinished)
        for shard, contents in stack.enter_context(contextlib.closing(work)):
            write(contents, results.path(shard))
            done += shard.count
            tell(done, total)
        for cell, ends, _ in results.cell_successes():
            if (counted := ends.total()) != campaign.trials:
                raise InputError(f"folder: got {counted} trials of {cell}, want {campaign.trials}: {results.command}")
    # What was run is what is replayed, also where a function makes another scenario each time.
    results.campaign, results.trials = campaign, trials
    return results


@contextlib.contextmanager
def _sole_writer(folder: Path) -> Iterator[None]:
    """Make the folder if it does not exist, and lock it during the block.

    The system releases the lock when the process dies, however it dies. File systems without locks are refused.
    """
    path = folder / "campaign.lock"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise InputError(f"folder: got {folder}, want one that can be written ({error.strerror})") from None
    try:
        try:
            _lock(handle)
        except OSError as error:
            got = f"{folder}, which another process writes (see {path.name}), want one at a time"
            if error.errno not in _HELD:
                got = f"{folder}, want one whose files can be locked ({error.strerror or error})"
            raise InputError(f"folder: got {got}") from None
        with contextlib.suppress(OSError):  # shows which process has the lock
            os.ftruncate(handle, 0)
            os.pwrite(handle, f"{os.getpid()}\n".encode(), 0) if hasattr(os, "pwrite") else None
        yield
    finally:
        os.close(handle)


if sys.platform == "win32":
    import msvcrt

    def _lock(handle: int) -> None:
        os.lseek(handle, 1 << 20, os.SEEK_SET)  # a byte that is never read: locked bytes cannot be read

        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
else:
    import fcntl

    def _lock(handle: int) -> None:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


@contextlib.contextmanager
def _resumable(folder: Path, scenario: str) -> Iterator[None]:
    """A block whose KeyboardInterrupt says how to go on, once the folder has a campaign."""
    try:
        yield
    except KeyboardInterrupt as stop:
        if (folder / MANIFEST).exists():
            command = Results(folder, scenario=scenario).command
            stop.add_note(f"{folder} has what is done; to go on, call run_campaign again, or run: {command}")
        raise


def _check_runnable(campaign: Campaign) -> list[list[Any]]:
    """Raise InputError for errors that would occur in every trial, before anything is solved or written.

    Returns the sweeps and strengths at which nothing is drawn.
    """
    scenario, given = campaign.resolved, campaign.given
    problem, plant = scenario.problem, scenario.plant()
    impossible = policies.impossible_policies(scenario, given)
    for policy in campaign.policies:
        if policy in impossible:
            possible = ", ".join(name for name in policies.CAMPAIGN_POLICIES if name not in impossible)
            raise InputError(f"policies: got {policy}, {impossible[policy]}, want some of {possible}")
    policies.check_used(given, campaign.policies)
    if problem.duration is None:
        plant.substeps(problem.dt)
    _ = campaign.goal_options  # raises InputError if they do not fit
    deterministic = list[list[Any]]()
    for sweep, strength in itertools.product(campaign.sweeps, campaign.strengths):
        scaled = [disturbance.scaled(strength) for disturbance in campaign.sweeps[sweep]]
        try:
            drawn = [_may_draw(campaign, disturbance) for disturbance in scaled]
        except InputError as error:
            raise InputError(f"sweeps: {sweep} at strength {strength:g}: {error}") from None
        deterministic += [] if any(drawn) else [[sweep, strength]]
    if {*policies.DESIGNED} & {*campaign.policies}:
        policies.design_uncertainty(scenario, campaign.design_disturbances)
    for cell in campaign.cells:
        if policies.POLICY_KINDS[cell.policy].per_cell:
            try:
                policies.design_uncertainty(scenario, campaign.disturbances(cell))
            except InputError as error:
                raise InputError(f"policies: {cell.policy} for {cell.sweep}: {error}") from None
    if campaign.replan_every is not None and campaign.replan_every < 0.999 * problem.dt:
        raise InputError(f"replan_every: got {campaign.replan_every:g} s, want at least {problem.dt:g}")
    return deterministic


def _may_draw(campaign: Campaign, disturbance: Disturbance) -> bool:
    """Whether trials may draw numbers for a disturbance: lqrsim's own do so as they start, others perhaps during a run.

    Raises InputError if the disturbance does not fit the robot.
    """
    problem, plant = campaign.resolved.problem, campaign.resolved.plant()
    states, m = np.tile(problem._start_or_zero, (problem.steps + 1, 1)), len(problem.control_coordinates)
    standing = Trajectory(states, np.zeros((problem.steps, m)), problem.dt)
    generator = np.random.default_rng(campaign.seed)
    untouched = generator.bit_generator.state
    try:
        disturbance.check(plant)
        disturbance.start(plant, standing, [generator])
    except InputError:
        raise
    except Exception:  # it may depend on the trial or the plan, and then counts as an error of those trials
        _log.debug("%s cannot be started beforehand", disturbance, exc_info=True)
        return True
    return not _is_packaged(type(disturbance)) or generator.bit_generator.state != untouched


def _is_packaged(kind: type[Disturbance]) -> bool:
    return kind.__module__.partition(".")[0] == "lqrsim"


def _specification(campaign: Campaign) -> dict[str, Any]:
    """The fields of the manifest that need no solve; they stay the same when the campaign is resumed."""
    scenario, given = campaign.resolved, campaign.given
    return {
        "campaign": campaign.as_json(),
        "model": _digest_of_runs(scenario),
        "problem": scenario.problem.digest,
        "start": solving.digest_of_start(scenario),
        "solution": None if given is None else solving.digest_of_solution(given),
        "code": _code(campaign),
    }


def _begin(campaign: Campaign, specification: dict[str, Any], folder: Path) -> None:
    """Solve; write the solutions and, at last, the manifest, with which the folder is that of a campaign."""
    scenario, given, design = campaign.resolved, campaign.given, campaign.design_disturbances
    solutions = policies.solve_policies(campaign.policies, scenario, design, given)
    for policy in {*policies.DESIGNED} & {*campaign.policies}:  # nothing is written if a controller cannot be made
        policies.make_controller(policies.POLICY_KINDS[policy].controller, scenario, solutions[policy], design=design)
    hashes = dict[str, dict[str, str]]()
    for policy, solution in solutions.items():
        path = save_load.save(solution, folder / "policies" / f"{policy}.npz")
        hashes[policy] = {"digest": solving.digest_of_solution(solution), "sha256": sha256(path.read_bytes())}
    if given is not None:
        save_load.save(given, folder / SOLUTION_FILE)
    remarks = [f"{name} {line}" for name, plan in solutions.items() for line in solving.remarks(scenario, plan)]
    impossible = policies.impossible_policies(scenario, given)
    missing = "; ".join(f"{name}, {impossible[name]}" for name in policies.DEFAULT_POLICIES if name in impossible)
    # Policies that were chosen leave out others on purpose.
    by_default = {*campaign.policies} == {*policies.DEFAULT_POLICIES} - {*impossible}
    write_manifest(folder, specification | {
        "policies": hashes, "versions": versions(), "machine": description(), "remarks": remarks,
        "left_out": f"left out: {missing}" if missing and by_default else "",
    })  # fmt: skip


def _check_same_campaign(specification: dict[str, Any], manifest: dict[str, Any], folder: Path) -> None:
    # Each sweep is compared as one field.
    now, before = (
        {f"sweeps: {name}": sweep for name, sweep in stated["sweeps"].items()} | {**stated, "sweeps": None}
        for stated in (specification["campaign"], manifest["campaign"])
    )
    for field in [*now, *before]:
        value, was = now.get(field), before.get(field)
        if field != "time_limit" and value != was:
            raise InputError(f"{field}: got {excerpt(value)}, want {excerpt(was)}, as in {folder}, or another folder")
    for field, parts in (
        ("model", "robot, MJCF, choice of obstacles, simulator or goal radius"), ("problem", "problem"),
        ("start", "start"),
    ):  # fmt: skip
        if specification[field] != manifest[field]:
            older = other_lqrsim(manifest["versions"])
            older = f", or with the hashes of {older}" if older else ""
            raise InputError(f"scenario: got a {parts} other than the one {folder} was begun with{older}, want another")
    if specification["solution"] != manifest["solution"]:
        got = "none" if specification["solution"] is None else "another"
        want = "none" if manifest["solution"] is None else folder / SOLUTION_FILE
        raise InputError(f"solution: got {got}, want {want}, as {folder} was begun with, or another folder")
    for kind, digest in specification["code"].items():
        if digest != manifest["code"].get(kind):
            raise InputError(f"{kind}: got a file that has changed since {folder} was begun, want it as it was then")


def _digest_of_runs(scenario: Scenario) -> str:
    """Hash of everything in a scenario that runs depend on, besides its problem, its start and the disturbances."""
    scene, robot, plant = scenario.scene, scenario.robot, scenario.plant()
    dynamics = robot.dynamics
    states, controls = dynamics.state_coordinates, dynamics.control_coordinates
    # Maps are code: their values at zero and at each unit vector stand for them.
    probes = [[*np.zeros((1, len(space))), *np.eye(len(space))] for space in (states, controls)]
    maps = [np.concatenate(robot.configuration(row)) for row in probes[0]], [robot.actuation(row) for row in probes[1]]
    spheres = robot.balls
    balls = [] if spheres is None else [spheres.radii, *(spheres.centres(dynamics, row) for row in probes[0])]
    names = robot.name, robot.body, robot.joints, robot.actuators, robot.wheels, dynamics.fixed
    numbers = robot.drag, robot.radius, plant.timestep, robot.activations, scene.geoms, dynamics.parameters
    stated: tuple[Any, ...] = (names, numbers, scenario.near_enough(), without_addresses(str(scenario.simulator)))
    stated += (scenario.sensors,) * bool(scenario.sensors)  # folders from before there were sensors stay valid
    rules = states.rules, controls.rules
    arrays = (np.asarray(values, dtype=np.float64) for values in (*maps[0], *maps[1], *balls))
    return sha256(scene.xml, repr(stated), *rules, *(part for array in arrays for part in (f"{array.shape}", array)))


def _code(campaign: Campaign) -> dict[str, str | None]:
    """The hash of the file that defines each of the user's disturbances; None if no file defines it."""
    used = itertools.chain(*campaign.sweeps.values(), campaign.design_disturbances or ())
    kinds, hashes = {type(disturbance) for disturbance in used}, dict[str, str | None]()
    for kind in sorted(kinds, key=lambda kind: kind.__qualname__):
        if not _is_packaged(kind):
            file = getattr(sys.modules.get(kind.__module__), "__file__", None)
            hashes[kind.__qualname__] = None if file is None else sha256(Path(file).read_bytes())
    return hashes


def _unfinished(results: Results) -> list[Shard]:
    """The shards that are still to be run. Removes half-written files, and moves damaged ones aside."""
    for remains in results.folder.glob("**/.unfinished-*"):
        remains.unlink(missing_ok=True)
    on_disk = results.shards_on_disk()
    return [shard for shard in results.shards() if shard not in on_disk or not _is_intact(results, shard)]


def _is_intact(results: Results, shard: Shard) -> bool:
    """Whether a shard's file is as it was written; if it is not, it is moved aside."""
    path = results.path(shard)
    try:
        read_table(path, shard, results.manifest["digest"])
    except Damaged as error:
        folder = results.folder / "damaged"
        try:
            folder.mkdir(exist_ok=True)
            aside = path.replace(folder / free_name(path.name, os.listdir(folder)))
        except OSError as problem:
            got = f"{path}, which is damaged and cannot be moved ({problem.strerror})"
            raise InputError(f"shard: got {got}, want it removed") from None
        _log.warning("%s was damaged (%s); moved it to %s, its trials run again", path.name, error, aside)
        return False
    return True
