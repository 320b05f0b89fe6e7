"""The layout of figures of drawn worlds and robots, in the renderer's own boxes: no two texts overlap, none is cut."""

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, get_args

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.text import Text
from mechanisms import NO_CONTACT, row
from sampling import examples
from tracking import by_hand

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.view import style
from lqrsim.view.plots import moved_objects

STEPS, DT = 20, 0.1
KINDS = ("sphere", "box", "capsule", "cylinder")


def flown(extent: Array, about: Array, controls: int, seed: int) -> tuple[ls.Solution, ls.Rollout]:
    """A plan along a curve of this extent (2 or 3,), and a run beside it; neither a solver nor MuJoCo is needed."""
    generator, size = np.random.default_rng(seed), len(extent)
    share = np.linspace(0, 1, STEPS + 1)[:, None]
    places = about + extent * np.hstack([share, share**2, np.sin(3 * share)])[:, :size]
    names = tuple("xyz"[:size])
    space = ls.types.Coordinates(names=(*names, "speed"), units=("m",) * size + ("m/s",), position=tuple(range(size)))
    pulls = ls.types.Coordinates(
        names=tuple(f"motor_{i}_of_{controls}" for i in range(controls)), units=("N",) * controls,
        low=(-50.0,) * controls, high=(50.0,) * controls,
    )  # fmt: skip
    states = np.hstack([places, np.ones((STEPS + 1, 1))])
    plan = ls.Trajectory(states, 40 * generator.normal(size=(STEPS, controls)), DT)
    policy = ls.AffinePolicy(
        gain=generator.normal(size=(STEPS, controls, size + 1)), offset=plan.controls, nominal=states[:-1], dt=DT,
        state_coordinates=space, control_coordinates=pulls,
    )  # fmt: skip
    flat = np.zeros((STEPS + 1, size + 1, size + 1)), np.zeros((STEPS + 1, size + 1)), np.linspace(9, 0, STEPS + 1)
    solution = replace(by_hand(plan, policy), cost_to_go=ls.types.Quadratic(*flat))
    beside = states + np.r_[0.02 * extent, 0.0] * np.sin(9 * share)
    none = np.array([np.inf])
    rollout = ls.Rollout(
        robot="own", body="b", scene="own", model="", plan=plan, policy_digest="", state_coordinates=space,
        control_coordinates=pulls, goal=None, goal_radius=0.1, radius=0.1 * float(extent.min()), states=beside[None],
        measured=beside[None], commanded=plan.controls[None], applied=plan.controls[None],
        forces=np.zeros((1, STEPS, 3)),
        torques=np.zeros((1, STEPS, 3)), displaced=np.zeros((1, 0, 3)), clearance=np.full((1, STEPS + 1), np.inf),
        contacts=np.zeros(1, np.int64), collided_at=none, obstacles=("",), diverged_at=none, failed_at=none,
        reasons=("",), frame_times=np.zeros(0), frames=np.zeros((1, 0, 0)), disturbances=(), seed=0,
    )  # fmt: skip
    return solution, rollout


def written(draw: Callable[..., Any], *arguments: Any, **options: Any) -> tuple[Figure, dict[Text, Array]]:
    """The figure that a function writes, and its texts with the settings that it is written with."""
    found: list[tuple[Figure, dict[Text, Array]]] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            Figure, "savefig", lambda self, file, **_: (found.append((self, texts(self))), file.write_bytes(b""))
        )
        draw(*arguments, **options)
    return found[0]


def texts(figure: Figure) -> dict[Text, Array]:
    """The texts that are seen, with their boxes (left, low, right, high) in pixels."""
    figure.draw_without_rendering()
    hidden: set[Text] = set()
    for axis in (one for axes in figure.axes for one in (axes.xaxis, axes.yaxis)):
        low, high = sorted(axis.get_view_interval())
        beyond = [tick for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks())
                  if not low - 1e-9 * abs(low) <= tick.get_loc() <= high + 1e-9 * abs(high)]  # fmt: skip
        hidden |= {text for tick in beyond for text in (tick.label1, tick.label2)}
    seen = [text for text in figure.findobj(Text) if text.get_visible() and text.get_text() and text not in hidden]
    return {text: np.array(text.get_window_extent().extents) for text in seen if isinstance(text, Text)}


def check_layout(figure: Figure, boxes: dict[Text, Array]) -> None:
    width, height = figure.bbox.size
    for text, (left, low, right, high) in boxes.items():
        # Hinting moves letters by up to a pixel.
        assert -1 <= left <= right <= width + 1, text
        assert -1 <= low <= high <= height + 1, text
    for (one, a), (other, b) in combinations(boxes.items(), 2):
        apart = max(a[0] - b[2], b[0] - a[2], a[1] - b[3], b[1] - a[3])
        assert apart > -1, (one, other)


LENGTHS = st.sampled_from([0.05, 1.0, 7.0, 60.0])


@given(st.data())
@settings(max_examples=examples(8))
def test_no_texts_overlap(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    extent = np.array(data.draw(st.lists(LENGTHS, min_size=2, max_size=3), label="extent"))
    about = np.full(len(extent), data.draw(st.sampled_from([0.0, -0.3, 1e4]), label="about"))
    seed, controls = data.draw(st.integers(0, 99), label="seed"), data.draw(st.sampled_from([1, 2, 8, 20]))
    looks = data.draw(st.sampled_from(get_args(style.Style)), label="style")
    solution, run = flown(extent, about, controls, seed)
    generator, centre = np.random.default_rng(seed), np.zeros(3)
    centre[: len(extent)] = about
    size = np.full(3, 0.2 * extent.min())
    world = ls.World(
        [
            ls.Obstacle(
                kind, kind, centre + np.pad(extent, (0, 3 - len(extent))) * generator.random(3), np.eye(3), size
            )
            for kind in data.draw(st.sets(st.sampled_from(KINDS)), label="obstacles")
        ]
    )
    path = tmp_path_factory.mktemp("figure") / "figure.png"
    if data.draw(st.booleans(), label="of the policy"):
        radius = run.radius if len(extent) == 2 else 0.0
        figure, boxes = written(ls.view.plot_policy, solution, path, world=world, radius=radius, style=looks)
    else:
        figure, boxes = written(ls.view.plot_run, solution, {"calm": run, "again": run}, path, world=world, style=looks)
    check_layout(figure, boxes)
    assert figure.get_figwidth() == style.LAYOUTS[looks].width
    assert looks == "screen" or min(float(text.get_fontsize()) for text in boxes) >= 7
    said = " ".join(text.get_text() for text in boxes)
    assert ("obstacle" in said) == bool(world.obstacles)
    check_scales(figure, len(extent))


def check_scales(figure: Figure, views: int) -> None:
    """A metre has as many pixels up as across, or the axis says how many times more."""
    for axes in figure.axes[: views - 1]:
        across, up = axes.bbox.width / np.ptp(axes.get_xlim()), axes.bbox.height / np.ptp(axes.get_ylim())
        for label, stretch in ((axes.get_xlabel(), across / up), (axes.get_ylabel(), up / across)):
            _, found, number = label.partition("stretched ")
            assert float(number.split("x")[0]) == pytest.approx(stretch, rel=0.06) if found else stretch <= 1.001
        assert 1 / 5.3 < axes.bbox.height / axes.bbox.width < 5.3


def ticks(axis: Axis) -> Array:
    low, high = sorted(axis.get_view_interval())
    return np.array([one for one in axis.get_majorticklocs() if low <= one <= high])


@pytest.mark.parametrize("value", [7.223735e-9, 26.05764589, -1e5, 0.0])
def test_rounding_errors_of_a_constant_are_not_seen(value: float, tmp_path: Path) -> None:
    def draw() -> None:
        with style.figure(tmp_path / "figure.png") as figure:
            axes = figure.add_subplot(style.arrange(figure, [style.Panel(1.0)])[0])
            axes.plot([0, 1, 2], value * (1 + 1e-13 * np.array([0, 1, 0])))
            axes.set(xlabel="number", ylabel="cost")

    figure, boxes = written(draw)
    check_layout(figure, boxes)
    seen = ticks(figure.axes[0].yaxis)
    assert len(seen) >= 2
    assert min(after - before for before, after in pairwise(seen)) > 1e-3 * abs(value)
    assert "+" not in figure.axes[0].get_ylabel()


PUSHED = row(
    ("hand", "crate", "stays"), joint='type="slide" axis="1 0 0"', geom=NO_CONTACT,
    places=("0 0 0", "1 0.5 0", "2 0 0"), geoms=('size="0.1"', 'type="box" size="0.2 0.1 0.1"', 'size="0.1"'),
    carried=("", '<joint type="slide" axis="0 1 0"/>', ""), actuators='<motor joint="hand"/>',
)  # fmt: skip


def test_what_a_run_moved_is_drawn_where_it_was(tmp_path: Path) -> None:
    """Three kinds of bodies: the robot's, one that moves and one that stays. Slides say where the second one is."""
    solution, run = flown(np.array([1.0, 1.0]), np.zeros(2), 1, 0)
    frames = np.zeros((1, 5, 4))
    frames[0, :, 0] = np.linspace(0, 1, 5)
    frames[0, :, 1:3] = np.linspace(0, 1, 5)[:, None] * [0.7, -0.2]
    run = replace(run, model=PUSHED, body="hand", frames=frames, frame_times=np.arange(5.0) / 4)
    assert mujoco.MjModel.from_xml_string(PUSHED).nq == 4
    (crate,) = moved_objects(run, 0)
    assert crate.name == "crate"
    np.testing.assert_allclose(crate.path, np.add([1, 0.5, 0], np.pad(frames[0, :, 1:3], ((0, 0), (0, 1)))), atol=1e-12)
    figure, boxes = written(ls.view.plot_run, solution, {"run": run}, tmp_path / "figure.png", world=ls.World())
    check_layout(figure, boxes)
    axes = figure.axes[0]
    first, last = (np.asarray(patch.get_path().vertices) for patch in axes.patches)
    for outline, middle in ((first, (1.0, 0.5)), (last, (1.7, 0.3))):
        np.testing.assert_allclose(outline.min(axis=0), np.subtract(middle, (0.2, 0.1)), atol=1e-12)
        np.testing.assert_allclose(outline.max(axis=0), np.add(middle, (0.2, 0.1)), atol=1e-12)
    low, high = np.array([axes.get_xlim(), axes.get_ylim()]).T
    assert (low < crate.path[:, :2].min(axis=0)).all()
    assert (crate.path[:, :2].max(axis=0) < high).all()
    assert "crate, moved" in axes.get_legend_handles_labels()[1]


def test_vector_figures_have_their_fonts_as_truetype(tmp_path: Path) -> None:
    solution, run = flown(np.array([1.0, 1.0]), np.zeros(2), 2, 0)
    path = ls.view.plot_run(solution, {"run": run}, tmp_path / "figure.pdf", world=ls.World(), style="column")
    contents = path.read_bytes()
    assert b"/FontFile2" in contents  # an embedded TrueType font, as in Table 124 of the standard
    assert b"/Type3" not in contents
    with pytest.raises(ls.InputError, match="style: got 'wide', want one of: screen, page, column"):
        ls.view.plot_run(solution, {"run": run}, path, world=ls.World(), style="wide")  # pyright: ignore
