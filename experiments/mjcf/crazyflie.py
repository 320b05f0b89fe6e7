"""The Crazyflie of the package `crazyflow`, which comes without joints and actuators, in the cage of Fig. 3."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

import lqrsim as ls
from lqrsim.scenes.scene import scene_from_xml

RADIUS = 0.07  # m, of the drone's collision sphere
SCALE = RADIUS / 0.3  # of the cage: the paper's quadrotor has a radius of 0.3 m
# What a motor can do, in round figures that the polynomials in the drone's file give at 3.3 V: N, and m of torque for
# its force. Motors 0 and 2 turn one way, 1 and 3 the other.
MOST, TORQUE = 0.15, 0.005


def crazyflie_in_cage(path: Path) -> ls.Scene:
    """The scene: the drone with a free joint and a motor at each of its sites, and the beams to its scale.

    Args:
      path: of the drone's MJCF.
    """
    root = ElementTree.parse(path).getroot()
    compiler, world = root.find("compiler"), root.find("worldbody")
    assert compiler is not None
    assert world is not None
    compiler.set("meshdir", str(path.parent / compiler.get("meshdir", "")))
    for fused in world.findall("body[@name='drone_fused']"):
        world.remove(fused)
    (drone,) = world.findall("body")
    drone.set("pos", "0 0 0")
    drone.insert(0, ElementTree.Element("freejoint"))
    beams, side = ElementTree.Element("frame"), 1.25 * SCALE
    for axis in range(3):
        for a in (-side, side):
            for b in (-side, side):
                place = np.insert([a, b], axis, 0.0)
                text = " ".join(f"{number:.6g}" for number in place)
                along = " ".join(str(int(number)) for number in np.eye(3)[axis])
                size = f"{0.4 * SCALE:.6g} {3 * SCALE:.6g}"
                kind = {"type": "cylinder", "size": size, "pos": text, "zaxis": along, "rgba": "0.2 0.38 0.62 0.25"}
                beams.append(ElementTree.Element("geom", {"name": f"beam_{len(beams)}", **kind}))
    for axis in range(3):
        for sign in (-1, 1):  # walls, floor and ceiling; what one looks through is not drawn
            place, inwards = 3 * SCALE * sign * np.eye(3)[axis], -sign * np.eye(3)[axis]
            kind = {"type": "plane", "size": "1 1 0.1", "group": "3", "rgba": "0.4 0.8 0.4 0.2"}
            kind |= {"pos": " ".join(f"{number:.6g}" for number in place)}
            kind |= {"zaxis": " ".join(str(int(number)) for number in inwards)}
            beams.append(ElementTree.Element("geom", {"name": f"wall_{axis}_{sign:+}", **kind}))
    world.append(beams)
    world.append(ElementTree.Element("light", {"pos": "-1 -1 3", "dir": "0.3 0.3 -1", "directional": "true"}))
    sky = {"name": "sky", "type": "skybox", "builtin": "flat", "rgb1": "0.93 0.95 0.97", "rgb2": "0.93 0.95 0.97"}
    assets, visual = ElementTree.Element("asset"), ElementTree.Element("visual")
    assets.append(ElementTree.Element("texture", sky | {"width": "16", "height": "16"}))
    visual.append(ElementTree.Element("headlight", {"ambient": "0.4 0.4 0.4", "diffuse": "0.4 0.4 0.4"}))
    visual.append(ElementTree.Element("global", {"offwidth": "1920", "offheight": "1080"}))
    root.extend([assets, visual])
    world.append(ElementTree.Element("camera", {"name": "overview", "pos": "-1.5 -3.4 1.75",
                                                "xyaxes": "0.94 -0.34 0 0.16 0.43 0.89", "fovy": "32"}))  # fmt: skip
    motors = ElementTree.Element("actuator")
    for number in range(4):
        gear = f"0 0 1 0 0 {TORQUE if number % 2 else -TORQUE}"
        motors.append(ElementTree.Element("motor", {"name": f"motor{number}", "site": f"motor{number}", "gear": gear,
                                                    "ctrlrange": f"0 {MOST}"}))  # fmt: skip
    root.append(motors)
    root.append(ElementTree.Element("option", {"timestep": "0.01", "integrator": "RK4"}))
    return scene_from_xml(ElementTree.tostring(root, encoding="unicode"), "crazyflie")
