"""The rule that makes obstacles of an MJCF, the packaged scenes, and what a bad file is told."""

import time
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mechanisms import motors, row
from mechanisms import scene as mjcf
from scipy.spatial.transform import Rotation

from lqrsim.errors import InputError
from lqrsim.robots.mjcf import MjcfRobot
from lqrsim.scenes.mjcf_model import MODELS, MOST, names
from lqrsim.scenes.scene import load_scene, scene_from_xml

# method.md, section 4, in metres
PILLARS = [
    *[(0, -1.35), (1, -0.5), (-0.95, -0.5), (-0.2, 0.3), (0.8, 0.7), (1.1, 2.0)],
    *[(-1.2, 0.8), (-1.1, 2.1), (-0.1, 1.6), (-1.1, -1.9), (1.1414, -1.6414)],
]


@pytest.fixture
def scene_of(tmp_path):
    """Loads a scene from the text of its worldbody, or from a whole file."""

    def load(body="", *, text=None):
        path = tmp_path / "mine.xml"
        path.write_text(text or mjcf(body, compiler=""))
        return load_scene(path)

    return load


def by_name(scene):
    return {obstacle.name: obstacle for obstacle in scene.world.obstacles}


def test_arena_is_the_one_of_the_paper():
    obstacles = by_name(load_scene("arena"))
    pillars = [obstacle for obstacle in obstacles.values() if obstacle.kind == "cylinder"]
    np.testing.assert_array_equal([pillar.position[:2] for pillar in pillars], PILLARS)
    assert {pillar.size[0] for pillar in pillars} == {0.2}
    planes = {name: obstacle for name, obstacle in obstacles.items() if obstacle.kind == "plane"}
    assert len(planes) + len(pillars) == len(obstacles)
    walls = [(plane.position.tolist(), plane.rotation[:, 2].round(12).tolist()) for plane in planes.values()]
    floor, west, east = ([0, 0, 0], [0, 0, 1]), ([-2, 0, 0], [1, 0, 0]), ([2, 0, 0], [-1, 0, 0])
    south, north = ([0, -3, 0], [0, 1, 0]), ([0, 3, 0], [0, -1, 0])
    assert sorted(walls) == sorted([floor, west, east, south, north])


def test_distances_in_the_arena_are_those_of_circles_and_a_rectangle():
    points = np.random.default_rng(0).uniform([-2, -3], [2, 3], (300, 2))
    to_pillars = np.linalg.norm(points[:, None] - np.array(PILLARS), axis=2).min(axis=1) - 0.2
    to_walls = np.minimum(2 - np.abs(points[:, 0]), 3 - np.abs(points[:, 1]))
    distance = load_scene("arena").world.seen_by("xy").distance(points)
    np.testing.assert_allclose(distance, np.minimum(to_pillars, to_walls), atol=1e-12)


def test_distances_in_the_cage_are_those_of_twelve_infinite_bars_and_a_cube():
    points = np.random.default_rng(0).uniform(-3, 3, (300, 3))
    distances = [3 - np.abs(points).max(axis=1)]
    for axis in range(3):
        across = np.delete(points, axis, axis=1)
        # The nearest of the four bars along this axis is the one of the same signs.
        distances.append(np.linalg.norm(np.abs(across) - 1.25, axis=1) - 0.4)
    world = load_scene("cage").world.seen_by("xyz")
    assert len(world) == 12 + 6
    np.testing.assert_allclose(world.distance(points), np.min(distances, axis=0), atol=1e-12)


def test_without_contacts_nothing_is_an_obstacle(scene_of):
    body = '<geom name="post" size="0.1"/>'
    assert scene_of(body).world.names == ("post",)
    for flag in ("contact", "constraint"):
        off = f'<option><flag {flag}="disable"/></option>'
        assert scene_of(text=mjcf(body, before=off)).world.names == ()


@pytest.mark.parametrize("name", names())
def test_packaged_scenes(name):
    scene = load_scene(name)
    assert scene.name == name
    assert scene.model.ncam >= 2
    assert not mujoco.mj_isSparse(scene.model)
    assert "include" not in scene.xml.replace("Include", "")
    # The text alone makes the very same model again, to the last bit.
    again = mujoco.MjModel.from_xml_string(scene.xml)
    from_file = mujoco.MjModel.from_xml_path(str(MODELS / f"{name}.xml"))
    for field in ("body_mass", "body_inertia", "geom_pos", "geom_size", "dof_damping", "actuator_gear", "cam_pos"):
        np.testing.assert_array_equal(getattr(again, field), getattr(from_file, field), err_msg=field)
    assert again.opt.timestep == from_file.opt.timestep == scene.model.opt.timestep


def test_what_is_fixed_and_can_collide_is_an_obstacle_and_nothing_else(scene_of):
    scene = scene_of("""
        <geom name="ball" type="sphere" size="0.1"/>
        <geom name="half" type="box" size="1 2 3" contype="0" conaffinity="1"/>
        <geom name="drawn" type="ellipsoid" size="1 2 3" contype="0" conaffinity="0"/>
        <body pos="1 0 0" euler="0 90 0"><geom type="capsule" size="0.1 0.5"/></body>
        <body><freejoint/><geom name="loose" type="sphere" size="0.1"/></body>
        <body mocap="true"><geom name="carried" type="sphere" size="0.1"/></body>
    """)
    obstacles = by_name(scene)
    assert list(obstacles) == ["ball", "half", "capsule 3"]
    np.testing.assert_array_equal(obstacles["half"].size, [1, 2, 3])
    np.testing.assert_allclose(obstacles["capsule 3"].position, [1, 0, 0])
    np.testing.assert_allclose(obstacles["capsule 3"].rotation[:, 2], [1, 0, 0], atol=1e-12)


FLOOR = '<geom name="floor" type="plane" size="1 1 1"/>'
CEILING = '<geom name="ceiling" type="plane" size="1 1 1" pos="0 0 2" zaxis="0 0 -1"/>'


@pytest.mark.parametrize(
    ("bar", "half_length"),
    [
        (FLOOR + CEILING + '<geom name="bar" type="cylinder" size="0.1 1" pos="0 0 1"/>', np.inf),
        (FLOOR + CEILING + '<geom name="bar" type="capsule" size="0.1 1.2" pos="0 0 1"/>', np.inf),
        (FLOOR + CEILING + '<geom name="bar" type="cylinder" size="0.1 0.9" pos="0 0 1"/>', 0.9),
        (FLOOR + '<geom name="bar" type="cylinder" size="0.1 1" pos="0 0 1"/>', 1),
        # Tilted: one rim of each end is still in the room, or none.
        (FLOOR + CEILING + '<geom name="bar" type="cylinder" size="0.2 1.41" pos="0 0 1" euler="0 45 0"/>', 1.41),
        (FLOOR + CEILING + '<geom name="bar" type="cylinder" size="0.2 1.7" pos="0 0 1" euler="0 45 0"/>', np.inf),
        # A log half sunk into the floor: its ends can be reached.
        (FLOOR + '<geom name="bar" type="cylinder" size="0.1 1" euler="0 90 0"/>', 1),
    ],
)
def test_a_bar_is_infinite_where_both_its_ends_are_in_walls(scene_of, bar, half_length):
    assert by_name(scene_of(bar))["bar"].size[1] == half_length


@pytest.mark.parametrize("kind", ["cylinder", "capsule"])
@pytest.mark.parametrize("seed", range(10))
def test_a_bar_behind_a_wall_is_nothing_before_it(scene_of, kind, seed):
    rng = np.random.default_rng(seed)
    turns, place, (radius, half) = Rotation.random(2, rng=rng), rng.normal(size=3), rng.uniform(0.1, 1, 2)
    normal = turns.as_matrix()[0, :, 2]
    centre = place - rng.uniform(2.5, 4) * normal
    walls, quats = [], [" ".join(map(repr, quat)) for quat in turns.as_quat(scalar_first=True).tolist()]
    for shape, at, quat in (("plane", place, quats[0]), (kind, centre, quats[1])):
        size = "1 1 1" if shape == "plane" else f"{radius} {half}"
        walls.append(f'<geom type="{shape}" size="{size}" pos="{" ".join(map(repr, at.tolist()))}" quat="{quat}"/>')
    points = place + rng.normal(size=(100, 3)) * 5
    points -= np.minimum(2 * (points - place) @ normal, 0)[:, None] * normal  # all before the wall
    alone, both = (scene_of("".join(some)).world.distance(points) for some in (walls[:1], walls))
    np.testing.assert_allclose(both, alone, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("asset", "geom", "kind"),
    [
        ("", '<geom name="egg" type="ellipsoid" size="1 2 3"/>', "ellipsoid"),
        (
            '<hfield name="h" nrow="2" ncol="2" size="1 1 1 1"/>',
            '<geom name="egg" type="hfield" hfield="h"/>',
            "hfield",
        ),
    ],
)
def test_an_obstacle_without_a_distance_is_refused_by_name(scene_of, asset, geom, kind):
    text = mjcf(geom, before=f"<asset>{asset}</asset>")
    with pytest.raises(InputError, match=f"^scene mine: got the obstacle 'egg' of type {kind}, want one of: plane"):
        scene_of(text=text)
    drawn = scene_of(text=text.replace('name="egg"', 'name="egg" contype="0" conaffinity="0"'))
    assert len(drawn.world) == 0


def test_a_mesh_is_its_convex_hull(scene_of):
    """Of a star without its inner corners, in MuJoCo's place; to the precision of single numbers in meshes."""
    star = "0 0 .9  .1 .1 .1  .8 0 0  -.1 .1 0  0 .7 0  -.6 0 0  0 -.5 0  0 0 -.4"
    geom = '<geom name="star" type="mesh" mesh="star" pos="1 2 3" euler="10 20 30"/>'
    asset = f'<asset><mesh name="star" vertex="{star}"/></asset>'
    scene = scene_of(text=mjcf(geom, before=asset, compiler=""))
    (obstacle,) = scene.world.obstacles
    spikes = np.array(star.split(), dtype=float).reshape(-1, 3)[[0, 2, 4, 5, 6, 7]]
    expected = Rotation.from_euler("XYZ", [10, 20, 30], degrees=True).apply(spikes) + np.array([1, 2, 3])
    found = obstacle.corners @ obstacle.rotation.T + obstacle.position
    assert len(found) == 6
    for one in expected:
        assert np.linalg.norm(found - one, axis=1).min() < 1e-6
    above = scene.world.seen_by("xy")  # its outline
    assert above.distance(expected[:, :2]).max() == pytest.approx(0.0, abs=1e-6)


def test_a_scene_of_ones_own_includes_the_packaged_robots_and_files_beside_it(tmp_path):
    (tmp_path / "rocks.xml").write_text(mjcf('<geom name="rock" type="sphere" size=".2"/>'))
    (tmp_path / "tetra.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    path = tmp_path / "garden.xml"
    included = """<include file="quadrotor.xml"/><include file="rocks.xml"/>
      <asset><mesh name="tetra" file="tetra.obj"/></asset>"""
    path.write_text(mjcf('<geom type="mesh" mesh="tetra" contype="0" conaffinity="0"/>', before=included))
    scene = load_scene(path)
    assert scene.world.names == ("rock",)
    assert mujoco.MjModel.from_xml_string(scene.xml).body("quadrotor").mass[0] == 0.5


LOOK = '<mujoco><default><geom rgba="{0} 0 0 1"/></default></mujoco>'
ARM = mjcf('<body name="arm"><joint name="turn"/><geom {2}/></body>', before="{0}<asset>{1}</asset>", compiler="")
INCLUDING = mjcf("", motors(["turn"]), before='<include file="parts/arm.xml"/>', compiler="")


@pytest.mark.parametrize("here", [("look.xml", "parts/look.xml"), ("parts/look.xml",)], ids=["main first", "nested"])
def test_includes_are_found_where_mujoco_finds_them(here, tmp_path):
    """MuJoCo looks beside the main file, and then beside the file that includes."""
    (tmp_path / "parts" / "more").mkdir(parents=True)
    for number, name in enumerate(here, 1):
        (tmp_path / name).write_text(LOOK.format(number / 4))
    arm = ARM.format('<include file="look.xml"/><include file="more/empty.xml"/>', "", 'size=".1"')
    (tmp_path / "parts" / "arm.xml").write_text(arm)
    (tmp_path / "parts" / "more" / "empty.xml").write_text('<mujoco><include file="deep.xml"/></mujoco>')
    (tmp_path / "parts" / "more" / "deep.xml").write_text('<mujoco><option timestep="0.007"/></mujoco>')
    path = tmp_path / "scene.xml"
    path.write_text(INCLUDING)
    model, wanted = MjcfRobot(path).scene.model, mujoco.MjModel.from_xml_path(str(path))
    np.testing.assert_array_equal(model.geom_rgba, wanted.geom_rgba)
    assert wanted.geom_rgba[0, 0] == 0.25
    assert model.opt.timestep == wanted.opt.timestep == 0.007


@pytest.mark.parametrize("folder", ["", "meshes"])
@pytest.mark.parametrize("both", [False, True], ids=["beside the included", "both"])
def test_meshes_and_models_of_an_included_file_are_found_where_mujoco_finds_them(folder, both, tmp_path):
    parts, meshes = tmp_path / "parts", tmp_path / folder
    parts.mkdir()
    meshes.mkdir(exist_ok=True)
    (parts / "claw.obj").write_text(TETRA.format(0.1))
    (parts / "hand.xml").write_text(HAND.format(asset="", geom="", size=0.1))
    if both:
        (meshes / "claw.obj").write_text(TETRA.format(0.3))
    compiler = f'<compiler meshdir="{folder}"/>' if folder else ""
    assets = '<mesh name="claw" file="claw.obj"/><model name="hand" file="hand.xml"/>'
    arm = ARM.format(compiler, assets, 'type="mesh" mesh="claw"')
    (parts / "arm.xml").write_text(arm.replace("</body>", '<attach model="hand" body="hand" prefix="left_"/></body>'))
    path = tmp_path / "scene.xml"
    path.write_text(INCLUDING)
    model, wanted = load_scene(path).model, mujoco.MjModel.from_xml_path(str(path))
    np.testing.assert_array_equal(model.mesh_vert, wanted.mesh_vert)
    np.testing.assert_array_equal(model.geom_size, wanted.geom_size)


@pytest.mark.parametrize("own", ['meshdir="a"', 'assetdir="b"', 'meshdir="a" assetdir="b"', 'texturedir="b"', ""])
@pytest.mark.parametrize("first", ['meshdir="a"', 'assetdir="b"', 'assetdir="a" meshdir="b"', ""])
@pytest.mark.parametrize("second", ['assetdir="a"', 'meshdir="b"', ""])
def test_meshes_are_in_the_folder_that_was_set_last(own, first, second, tmp_path):
    """An assetdir also counts against an earlier meshdir, as when an included file has it."""
    for number, folder in enumerate(("", "a", "b", "parts", "parts/a", "parts/b"), 1):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / "claw.obj").write_text(TETRA.format(number / 10))
    compilers = f"<compiler {first}/><compiler {second}/>"
    arm = ARM.format(compilers, '<mesh name="claw" file="claw.obj"/>', 'type="mesh" mesh="claw"')
    (tmp_path / "parts" / "arm.xml").write_text(arm)
    path = tmp_path / "scene.xml"
    path.write_text(INCLUDING.replace("<compiler ", f"<compiler {own}"))
    model, wanted = load_scene(path).model, mujoco.MjModel.from_xml_path(str(path))
    np.testing.assert_array_equal(model.mesh_vert, wanted.mesh_vert)


HAND = mjcf(
    """<body name="hand" pos=".5 0 0"><joint name="grip" range="-40 40"/><geom name="palm" size="{size}"/>{geom}
    <site name="tip" pos=".1 0 0"/></body>""",
    '<position name="grip" joint="grip" kp="3"/>',
    before="{asset}",
    compiler="",
)
HOLDING = mjcf(
    """<body name="arm"><joint name="turn"/><geom size=".1"/>
    <frame pos="0 0 .2"><attach model="hand" body="hand" prefix="left_"/></frame></body>""",
    motors(["turn"]),
    before='<asset><model name="hand" file="{}"/></asset>',
)
TETRA = "v 0 0 0\nv {0} 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.mark.parametrize("where", ["hand.xml", "parts/hand.xml", "/hand.xml"], ids=["beside", "below", "absolute"])
@pytest.mark.parametrize("meshed", [False, True], ids=["plain", "meshed"])
def test_an_attached_model_is_that_beside_the_file(where, meshed, tmp_path, monkeypatch):
    """As MuJoCo finds it by the path of the file, wherever the process runs, and whatever lies there."""
    asset = '<asset><mesh name="claw" file="claw.obj"/></asset>' if meshed else ""
    geom = '<geom name="claw" type="mesh" mesh="claw" mass="1"/>' if meshed else ""
    for folder, size, length in ((tmp_path / "robot", 0.1, 0.1), (tmp_path / "elsewhere", 0.2, 0.3)):
        for own in (folder, folder / "parts"):
            own.mkdir(parents=True, exist_ok=True)
            (own / "hand.xml").write_text(HAND.format(asset=asset, geom=geom, size=size))
            (own / "claw.obj").write_text(TETRA.format(length))
    path = tmp_path / "robot" / "arm.xml"
    name = str(tmp_path / "robot" / "hand.xml") if where.startswith("/") else where
    path.write_text(HOLDING.format(name))
    monkeypatch.chdir(tmp_path / "elsewhere")
    model, wanted = MjcfRobot(path).scene.model, mujoco.MjModel.from_xml_path(str(path))
    assert model.nq == 2
    for field in ("body_mass", "body_inertia", "body_pos", "geom_size", "jnt_range", "actuator_gainprm", "site_pos"):
        np.testing.assert_array_equal(getattr(model, field), getattr(wanted, field), err_msg=field)


@pytest.mark.parametrize("unnamed", ["body", "joint", "geom", "position"])
def test_an_attached_model_without_names_gets_some(unnamed, tmp_path):
    """A state or control without a name of its own could not be told from another."""
    hand = HAND.format(asset="", geom='<body name="tip"><geom name="nail" size=".1"/></body>', size=0.1)
    name = {"body": ' name="tip"', "joint": ' name="grip"', "geom": ' name="nail"', "position": ' name="grip"'}[unnamed]
    hand = hand.replace(f"<{unnamed}{name}", f"<{unnamed}").replace(' joint="grip"', ' site="tip"')
    (tmp_path / "hand.xml").write_text(hand)
    path = tmp_path / "arm.xml"
    path.write_text(HOLDING.format("hand.xml"))
    model, kind = MjcfRobot(path).scene.model, "actuator" if unnamed == "position" else unnamed
    for one, count in (
        ("body", model.nbody),
        ("joint", model.njnt),
        ("geom", model.ngeom),
        ("actuator", model.nactuator),
    ):
        found = [getattr(model, one)(number).name for number in range(count)]
        assert len({*found}) == len(found)
        assert any(name.startswith(f"unnamed_{kind}_") for name in found) or one != kind


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<mujoco><worldbody></mujoco>", r"^scene: got mine.xml, which is not XML \(mismatched tag: line 1, col"),
        ("<sdf/>", "^scene: got mine.xml with <sdf> at its root, want <mujoco>$"),
        ("<robot/>", r"^scene: got mine.xml, which is a URDF, want a name that ends in \.urdf; to be included it"),
        (
            mjcf("<geom typ='box'/>"),
            "^scene mine: got an MJCF that MuJoCo refuses: XML Error: Schema violation: unrecognized attribute: 'typ'",
        ),
        (
            mjcf("<geom type='box' size='0 1 1'/>"),
            "^scene mine: got an MJCF that MuJoCo refuses: Error: size 0 must be positive in geom",
        ),
        (
            mjcf("", before='<include file="crate.xml"/>'),
            "^scene: got an include of 'crate.xml', want a file beside mine.xml or one of: arena.xml, cage.xml, create",
        ),
        (
            mjcf("", before=2 * '<include file="create.xml"/>'),
            "^scene: got create.xml included twice in mine.xml, want each file once$",
        ),
    ],
)
def test_a_bad_file_is_told_in_one_line(scene_of, text, message):
    with pytest.raises(InputError, match=message):
        scene_of(text=text)


def test_a_file_with_nearly_that_name_is_offered(tmp_path: Path) -> None:
    (tmp_path / "excavator.xml").write_text(mjcf(""))
    with pytest.raises(InputError, match=r"\(did you mean .*excavator\.xml\?\)$"):
        load_scene(tmp_path / "excavater.xml")


@pytest.mark.skipif(mujoco.__version__ != "4.0.0", reason="the bug is in 4.0.0 alone")
def test_a_sparse_model_is_refused_where_mujoco_solves_it_wrongly(scene_of):
    with pytest.raises(InputError, match=r"^scene mine: got a sparse constraint Jacobian, which MuJoCo 4.0.0"):
        scene_of(text=row("a", option='jacobian="sparse"'))


def test_elements_nested_by_the_thousand_get_one_line(tmp_path):
    deep = mjcf("<body><geom size='1'/>" * 3000 + "</body>" * 3000)
    (tmp_path / "deep.xml").write_text(deep)
    with pytest.raises(InputError, match=r"^scene deep: got elements nested deeper than 490"):
        scene_from_xml(deep, "deep")
    with pytest.raises(InputError, match=r"^scene: got deep.xml with elements nested deeper than 490"):
        load_scene(tmp_path / "deep.xml")


def test_a_huge_height_field_gets_one_line(scene_of):
    asset = '<asset><hfield name="land" nrow="100000" ncol="100000" size="1 1 1 1"/></asset>'
    with pytest.raises(
        InputError, match="got 100000 x 100000 heights in the height field 'land', want 16,777,216 at most"
    ):
        scene_from_xml(mjcf("<geom size='1'/>", before=asset), "hills")


def test_a_nan_in_the_file_gets_one_line_and_leaves_no_log(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        InputError, match=r"^scene odd: got NaN in the MJCF \(MuJoCo's actuator_\w+\[0\]\), want numbers"
    ):
        scene_from_xml(row("j", actuators='<motor joint="j" gear="nan"/>'), "odd")
    assert not list(tmp_path.iterdir())


def test_names_that_obstacles_without_one_get_are_free(scene_of):
    scene = scene_of("""
        <geom size="0.1"/>
        <geom name="sphere 0" size="0.2"/>
        <geom name="sphere 0_" size="0.3"/>
    """)
    assert list(by_name(scene)) == ["sphere 0__", "sphere 0", "sphere 0_"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            '<replicate count="100000000" offset="1 0 0"><geom size="1"/></replicate>',
            "100,000,000 copies, want 1,000,000",
        ),
        (
            '<replicate count="9999" offset="1 0 0"><replicate count="999" offset="0 1 0"><geom size="1"/></replicate>'
            "</replicate>",
            "<replicate> of 9,989,001 copies",
        ),
        ('<body><geom name="load" mass="nan" size="1"/></body>', "got NaN for the mass of geom 'load', want a number"),
        ('<body><geom density="NaN" size="1"/></body>', "got NaN for the density of geom, want a number"),
        ('<body><geom mass="-nan(1)" size="1"/></body>', "got NaN for the mass of geom, want a number"),
        ('<replicate count=" +900000000" offset="1 0 0"><geom size="1"/></replicate>', "900,000,000 copies"),
        ('<replicate count="1000001" offset="1 0 0"/>', "<replicate> of 1,000,001 copies"),
        (
            '<body><flexcomp name="f" type="grid" dim="2" spacing="1 1 1" count="99999 99999 1"/></body>',
            "<flexcomp> of 9,999,800,001 copies",
        ),
        *[
            (f'<geom size="1"/></worldbody><{one}/><worldbody>', f"{said} in <{one.split()[0]}>, want .* at most")
            for one, said in (
                *((f'size {key}="{most + 1}"', f"{key}='{most + 1}'") for key, most in MOST["size"].items()),
                *((f'quality {key}="+9e9"', rf"{key}='\+9e9'") for key in MOST["quality"]),
                *((f'size nuser_{kind}="10001"', f"nuser_{kind}='10001'") for kind in ("body", "geom", "sensor")),
                ('size memory="5G"', "memory='5G'"),
                ('size memory="1E"', "memory='1E'"),
            )
        ],
        *[
            (
                f'<geom size="1"/></worldbody><asset><texture name="t" {sizes}/></asset><worldbody>',
                "pixels in <texture>",
            )
            for sizes in (
                'type="2d" builtin="flat" width="30000" height="30000"',
                'builtin="flat" width="20000" height="20000"',
                'type="skybox" builtin="gradient" width="10" height="9000000"',
            )
        ],
        ('<geom size="1"/></worldbody><compiler boundmass="nan"/><worldbody>', "got NaN for the boundmass of compiler"),
        ('<geom size="1"/></worldbody><option timestep="nan"/><worldbody>', "got the timestep nan, want a finite"),
        ('<geom size="1"/></worldbody><option timestep="0"/><worldbody>', "got the timestep 0, want a finite"),
        ('<geom size="1"/></worldbody><option timestep="inf"/><worldbody>', "got the timestep inf, want a finite"),
        ('<geom size="1"/></worldbody><option gravity="0 0 nan"/><worldbody>', r"got gravity \[0.0, 0.0, nan\], want"),
    ],
)
def test_what_mujoco_would_not_survive_or_not_say(text, message):
    with pytest.raises(InputError, match=f"^scene odd: got .*{message}|^scene odd: {message}"):
        scene_from_xml(mjcf(text), "odd")


def test_replicas_are_obstacles_and_thousands_of_them_are_loaded_quickly():
    """In processor time, as a ratio: at most three times what MuJoCo needs by itself, in the best of five."""
    text = mjcf("""<light/><camera pos="0 0 1"/><replicate count="100" offset="1 0 0"><replicate count="50"
      offset="0 1 0"><geom type="box" size=".1 .1 .1"/></replicate></replicate>""")

    def seconds(load):
        began = time.process_time()
        load()
        return time.process_time() - began

    assert len(scene_from_xml(text, "many").world) == 5000
    alone = min(seconds(lambda: mujoco.MjModel.from_xml_string(text)) for _ in range(5))
    assert min(seconds(lambda: scene_from_xml(text, "many")) for _ in range(5)) < 3 * alone + 0.1
