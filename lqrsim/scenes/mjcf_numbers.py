"""The numbers of an MJCF that can be changed: masses, damping, friction, gears. Read from a model, changed in the text.

The text is changed because MuJoCo derives other numbers when it compiles the text.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from lqrsim.errors import InputError, check_number

WHOLE = "mass"  # name of the mass of all moving bodies together
_OF_JOINTS = ("damping", "stiffness", "armature", "frictionloss")
_MEDIUM = ("density", "viscosity")
_BOUNDS = {"mass": {"above": 0.0}, "gear": {}}  # bounds; all other numbers must not be negative


@dataclass(frozen=True)
class Number:
    """A number of an MJCF: its kind, its body, joint, geom or actuator (empty for all), and its value."""

    what: str
    part: str
    value: float


def numbers_of(xml: str, model: mujoco.MjModel) -> dict[str, Number]:
    """All such numbers, by the names of parameters: `mass`, `<body>_mass`, `<joint>_damping`, `<actuator>_gear`.

    Numbers are listed only for elements that have a name and this number in the text: bodies that move, geoms that
    collide.

    Args:
      xml: an MJCF whose elements all have names. model: the model compiled from it.
    """
    elements, found = _elements(ElementTree.fromstring(xml)), list[Number]()
    masses = {name: float(model.body(name).mass[0]) for name in _heavy(model)}
    if _bodies(model) == elements["body"].keys():  # otherwise the text has no place for some masses
        found += [Number("mass", "", sum(masses.values()))] if masses else []
        found += [Number("mass", name, mass) for name, mass in masses.items()]
    for number in range(model.njnt):
        name, dof = model.joint(number).name, int(model.jnt_dofadr[number])
        if name in elements["joint"]:
            values = {key: getattr(model, f"dof_{key}")[dof] for key in _OF_JOINTS if key != "stiffness"}
            values["stiffness"] = model.jnt_stiffness[number]
            found += [Number(key, name, float(values[key])) for key in _OF_JOINTS]
    for number in np.flatnonzero((model.geom_contype != 0) | (model.geom_conaffinity != 0)):
        if (name := model.geom(number).name) in elements["geom"]:
            found.append(Number("friction", name, float(model.geom_friction[number, 0])))
    for number, gear in enumerate(model.actuator_gear[model.actuator_outadr]):
        if (name := model.actuator(number).name) in elements["actuator"] and gear.any():
            found.append(Number("gear", name, float(gear[np.abs(gear).argmax()])))
    found += [Number(key, "", float(getattr(model.opt, key))) for key in _MEDIUM]
    return {f"{one.part}_{one.what}" if one.part else one.what: one for one in found}


def with_numbers(xml: str, model: mujoco.MjModel, values: Mapping[str, float], what: str) -> str:
    """The MJCF with changed numbers, by name, as in `numbers_of`.

    A body's inertia scales with its mass; `mass` scales all bodies. The numbers of a gear keep their ratios.

    Args:
      what: name of the MJCF in messages.

    Raises:
      InputError: a value is out of range, or both the whole mass and the mass of a body are given.
    """
    numbers, root = numbers_of(xml, model), ElementTree.fromstring(xml)
    elements, scales = _elements(root), dict[str, float]()
    for name, value in values.items():
        one = numbers[name]
        value = check_number(f"{what}: {name}", value, **_BOUNDS.get(one.what, {"at_least": 0.0}))
        ratio = value / one.value if one.value else 0.0
        if name == WHOLE:
            scales |= dict.fromkeys(_heavy(model), ratio)
            if other := next((key for key in values if key != WHOLE and numbers[key].what == "mass"), None):
                raise InputError(f"{what}: {WHOLE}: got {WHOLE} and {other}, want one of the two")
        elif one.what == "mass":
            scales[one.part] = ratio
        elif one.what in _OF_JOINTS:
            _set(elements["joint"][one.part], one.what, [value, *_higher(model, one)])
        elif one.what == "friction":
            _set(elements["geom"][one.part], "friction", [value, *model.geom(one.part).friction[1:]])
        elif one.what == "gear":
            _set(
                elements["actuator"][one.part],
                "gear",
                [*(ratio * np.reshape(model.actuator(one.part).gear, (-1, 6))[0])],
            )
        else:
            _set(ElementTree.SubElement(root, "option"), one.what, [value])  # the last element takes precedence
    if scales:
        _state_masses(root, elements["body"], model, scales)
    return ElementTree.tostring(root, encoding="unicode")


def _state_masses(
    root: ElementTree.Element,
    bodies: Mapping[str, ElementTree.Element],
    model: mujoco.MjModel,
    scales: Mapping[str, float],
) -> None:
    """Write the compiled mass and inertia of each body, times its scale, in place of the elements they came from."""
    for name, body in bodies.items():
        for inertial in body.findall("inertial"):
            body.remove(inertial)
        compiled, scale = model.body(name), scales.get(name, 1.0)
        if compiled.mass[0] > 0:
            inertial = ElementTree.Element("inertial")
            _set(inertial, "pos", [*compiled.ipos])
            _set(inertial, "quat", [*compiled.iquat])
            _set(inertial, "mass", [scale * compiled.mass[0]])
            _set(inertial, "diaginertia", [*(scale * compiled.inertia)])
            body.insert(0, inertial)
    compiler = {"inertiafromgeom": "false", "settotalmass": "-1", "boundmass": "0", "boundinertia": "0"}
    ElementTree.SubElement(root, "compiler", compiler)


def _elements(root: ElementTree.Element) -> dict[str, dict[str, ElementTree.Element]]:
    """The named elements, by kind and name. Replicas have other names in the model, and are not found."""
    found = {"body": {}, "joint": {}, "geom": {}, "actuator": {}}
    for world in root.iter("worldbody"):
        for element in world.iter():
            if element.tag in found:
                found[element.tag][element.get("name", "")] = element
    for section in root.findall("actuator"):
        found["actuator"] |= {element.get("name", ""): element for element in section}
    return found


def _bodies(model: mujoco.MjModel) -> set[str]:
    return {model.body(number).name for number in range(1, model.nbody)}


def _heavy(model: mujoco.MjModel) -> list[str]:
    """The bodies with mass that move, by themselves or with others."""
    moves = (model.body_treeid >= 0) & (model.body_mass > 0)
    return [model.body(number).name for number in np.flatnonzero(moves)]


def _higher(model: mujoco.MjModel, one: Number) -> list[float]:
    """The rest of the attribute after its linear coefficient: damping and stiffness may be polynomials."""
    joint = model.joint(one.part).id
    if one.what == "stiffness":
        return model.jnt_stiffnesspoly[joint].tolist()
    return model.dof_dampingpoly[model.jnt_dofadr[joint]].tolist() if one.what == "damping" else []


def _set(element: ElementTree.Element, name: str, numbers: list[float]) -> None:
    """Write numbers so that they read back exactly."""
    element.set(name, " ".join(repr(float(number)) for number in numbers))
