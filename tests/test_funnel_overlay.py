"""Funnels in stills and videos: where their ellipsoids are, what of them is drawn, and what captions say."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from tracking import funnel_by_hand

import lqrsim as ls
from lqrsim.cli import main
from lqrsim.verify import EMPTY
from lqrsim.view import gl
from lqrsim.view.options import OVERLAYS, Overlay
from lqrsim.view.overlays import INTERPOLATED, DrawnTube, Overlays, Scale, colour_of, legend_entries
from lqrsim.view.picture import open_picture
from lqrsim.view.recorded_trial import RecordedTrial

draws = pytest.mark.skipif(bool(gl.missing()), reason=f"no OpenGL here: {gl.INSTALL}")
SMALL = (320, 180)


@pytest.fixture(scope="module")
def drive(differential_drive: ls.Scenario, drive_solution: ls.Solution) -> ls.Rollout:
    push = ls.disturbances.Push((4.0, 4.0, 0.0), at=5.0)
    return ls.simulate(differential_drive.plant(), drive_solution, disturbances=[push], seed=3)


@pytest.fixture(scope="module")
def flight(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> ls.Rollout:
    return ls.simulate(quadrotor.plant(), quadrotor_solution, seed=3)


@pytest.fixture(params=["drive", "flight"])
def flown(request: pytest.FixtureRequest, drive_solution: Any, quadrotor_solution: Any) -> tuple[Any, Any]:
    """A run and its solution, of either robot."""
    solution = drive_solution if request.param == "drive" else quadrotor_solution
    return request.getfixturevalue(request.param), solution


def random_shapes(solution: ls.Solution, size: int) -> np.ndarray:
    """(T+1, size, size)."""
    factors = 0.1 * np.random.default_rng(1).normal(size=(solution.trajectory.steps + 1, size, size))
    return factors @ factors.transpose(0, 2, 1) + 1e-3 * np.eye(size)


def overlays_of(run: ls.Rollout, funnel: ls.types.Funnel) -> Overlays:
    return Overlays(RecordedTrial(run, 0), ("funnel",), Scale(1.0, 1.0), funnel=funnel)


def test_what_is_drawn_is_the_shadow_of_the_funnel(flown: tuple[ls.Rollout, ls.Solution]) -> None:
    """Points on the boundary are at their level, of all states with that position at the one that is least.

    That least is of x' shape^-1 x over the states that are not the position: it is solved for here, where the package
    projects the shape.
    """
    run, solution = flown
    size, n = len(run.state_coordinates.position), len(run.state_coordinates)
    knots, levels = (5, 60, 100), (0.5, 1.5, 0.0)
    funnel = funnel_by_hand(solution, random_shapes(solution, n), knots=knots, levels=levels)
    tubes = [tube for tube in overlays_of(run, funnel).drawables if isinstance(tube, DrawnTube)]
    certified, between = (tube.knots for tube in tubes)
    assert certified.tolist() == [5, 60]  # none where the level is 0
    assert (between.min(), between.max()) == (6, 99)  # and none before the first knot or after the last one
    assert 60 not in between
    for tube in tubes:
        each = tube.knots, tube.centres, tube.half_axes, tube.rotations
        for knot, centre, half_axes, rotation in zip(*each, strict=True):
            assert centre[:size] == pytest.approx(run.plan.states[knot, :size])
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
            curve, level = np.linalg.inv(funnel.shape[knot]), np.interp(knot, knots, levels)
            for end in (rotation * half_axes)[:size, :size].T:
                rest = -np.linalg.solve(curve[size:, size:], curve[size:, :size] @ end)
                state = np.concatenate([end, rest])
                # Inverting the shape costs some of the digits; what is narrower than the overlay's least is not.
                assert np.linalg.norm(end) > 1e-3
                assert state @ curve @ state == pytest.approx(level**2, rel=1e-5)


def test_what_the_legend_says(flight: ls.Rollout, quadrotor_solution: ls.Solution) -> None:
    """What is drawn, and nothing of what is not: one knot has nothing between, and without levels there is nothing."""
    certified = ("funnel: 90 % succeed, confidence 95 %", colour_of("funnel"))
    between = ("funnel, interpolated", INTERPOLATED)
    for knots, levels, said in (
        ((0, 9), (1.0, 1.0), [certified, between]),
        ((4,), (1.0,), [certified]),
        ((0, 9), (0.0, 0.0), []),
    ):
        overlays = overlays_of(flight, funnel_by_hand(quadrotor_solution, 0.01 * np.eye(3), knots=knots, levels=levels))
        assert list(legend_entries([overlays]).items()) == said


def test_the_caption_says_where_the_run_is(drive: ls.Rollout, drive_solution: ls.Solution) -> None:
    """Against the distance to the plan: the funnel is a disc of 5 cm, from 2 s to 10 s."""
    funnel = funnel_by_hand(drive_solution, np.eye(2), knots=(12, 60), levels=(0.05, 0.05))
    off = np.linalg.norm((drive.states[0] - drive.plan.states)[:, :2], axis=1)
    expected = ["in the funnel" if one < 0.05 else "outside the funnel" for one in off]
    expected[:12] = ["no funnel here"] * 12
    expected[61:] = ["no funnel here"] * (len(off) - 61)
    assert overlays_of(drive, funnel).membership == tuple(expected)
    assert set(expected) == {"in the funnel", "outside the funnel", "no funnel here"}
    assert funnel.left_at(drive)[0] == pytest.approx(expected.index("outside the funnel") / 6)


@draws
def test_it_is_seen_where_it_is(flight: ls.Rollout, quadrotor_solution: ls.Solution) -> None:
    """Balls of 15 cm from above: pixels change where the camera's own formula sees them, and nowhere else.

    They change most where it is certified, and not at all after the last knot.
    """
    where: dict[int, np.ndarray] = {}

    def picture(*levels: float, knots: tuple[int, ...] = (60, 110)) -> np.ndarray:
        funnel = funnel_by_hand(quadrotor_solution, 0.15**2 * np.eye(3), knots=knots, levels=levels or (0.0, 0.0))
        show: tuple[Overlay, ...] = ("funnel",) if levels else ()
        about = funnel if levels else None
        with open_picture(
            flight, camera="top", overlays=show, funnel=about, quality="draft", size=(640, 360)
        ) as drawn:  # fmt: skip
            camera = drawn.panes[0].camera
            assert camera is not None
            for knot in (10, 60, 85, 110, 130):
                around = flight.plan.states[knot, :3] + 0.15 * np.vstack([np.eye(3), -np.eye(3), np.zeros(3)])
                where[knot] = np.array([camera.project(point, (640, 360)) for point in around])
            return drawn.draw(0.5).astype(int)

    bare = picture()

    def at(knot: int) -> float:
        column, row = where[knot][-1].astype(int)
        return float(np.abs(both - bare).max(axis=2)[row - 2 : row + 3, column - 2 : column + 3].mean())

    rows, columns = np.nonzero(np.abs(picture(1.0, knots=(60,)) - bare).max(axis=2) > 4)
    for axis, found in enumerate((columns, rows)):
        assert found.min() + 0.5 == pytest.approx(where[60][:, axis].min(), abs=2)  # pixels
        assert found.max() + 0.5 == pytest.approx(where[60][:, axis].max(), abs=2)
    both = picture(1.0, 1.0)
    assert min(at(60), at(110)) > at(85) > 4
    assert at(10) == at(130) == 0
    # Nothing of it is as green as the mark that `lqrsim verify` reads.
    green = [one[..., 1] - one[..., [0, 2]].max(axis=2) > 255 * EMPTY for one in (both, bare)]
    assert green[1].any()
    np.testing.assert_array_equal(*green)
    np.testing.assert_array_equal(picture(0.0, 0.0), bare)


@draws
def test_in_a_video_and_beside_another(
    drive: ls.Rollout, drive_solution: ls.Solution, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """On the command line: two runs with a funnel each, and a still; without it, the picture is another."""
    wide, narrow = (
        funnel_by_hand(drive_solution, std**2 * np.eye(3), knots=(0, 60), levels=(1.0, 1.0)) for std in (0.3, 0.1)
    )
    run = str(ls.save(drive, tmp_path / "run.npz"))
    files = [str(ls.save(one, tmp_path / f"{n}.npz")) for n, one in enumerate((wide, narrow))]
    look = ["--size", "320", "180", "--overlays", "plan", "funnel"]
    pictures = []
    for funnels in (files[:1], files):
        out = str(tmp_path / f"{len(funnels)}.png")
        assert main(["render", run, run, "--trial", "0", "0", *look, "--out", out, "--funnel", *funnels]) == 0
        pictures.append(np.asarray(Image.open(out)).astype(int))
    left, right = (np.abs(pictures[0] - pictures[1]).max(axis=2)[:, part] > 8 for part in (slice(160), slice(160, 320)))
    assert not left.any()
    assert right.mean() > 0.005
    out = str(tmp_path / "run.mp4")
    video = ["--fps", "2", "--speed", "10", "--out", out]
    assert main(["render", run, *look, *video, "--funnel", files[0]]) == 0
    assert (tmp_path / "run.mp4").stat().st_size > 1000
    capsys.readouterr()
    assert main(["render", run, *look, *video]) == 2
    assert "funnel: got None with the overlay funnel" in capsys.readouterr().err


def test_refused(flight: ls.Rollout, quadrotor_solution: ls.Solution, tmp_path: Path) -> None:
    whole = funnel_by_hand(quadrotor_solution, np.eye(3))
    moved = replace(whole, plan=replace(whole.plan, states=whole.plan.states + 1))
    flat = funnel_by_hand(quadrotor_solution, np.eye(2))
    unchecked: Any = ls.render
    assert "funnel" not in OVERLAYS
    for wrong, said in (
        (None, "funnel: got None with the overlay funnel"),
        (moved, "funnel: got a funnel about another plan"),
        (flat, "states: got x, y, want the position among them"),
        (3, "funnel: got 3"),
        ((whole, whole), "funnel: got 2, want one for each of 1 runs"),
    ):
        with pytest.raises(ls.InputError) as caught:
            unchecked(flight, tmp_path / "a.png", overlays=("funnel",), funnel=wrong, size=SMALL)
        assert said in str(caught.value)
