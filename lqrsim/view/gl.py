"""An OpenGL context that needs no display, bound when the first picture is drawn.

On Linux MuJoCo chooses its OpenGL while it is imported and takes the one that needs a display, unless MUJOCO_GL names
another; with MUJOCO_GL=egl and no EGL library it cannot even be imported. So nothing is chosen ahead of time: EGL, or
else OSMesa, is put in place once MuJoCo is there and a library is found. macOS and Windows bring their own OpenGL.
"""

import functools
import importlib
import os
import sys
from ctypes.util import find_library

from lqrsim.errors import InputError

INSTALL = "sudo apt-get install -y libegl1 libgl1-mesa-dri libopengl0"


@functools.cache
def bind() -> None:
    """Makes sure that MuJoCo can draw without a display; a choice made in MUJOCO_GL is kept.

    Raises:
      InputError: there is no OpenGL library, or it does not work; the message says how to get one.
    """
    if sys.platform != "linux":
        return
    choice = os.environ.get("MUJOCO_GL", "").strip().lower()
    if choice in ("0", "disable", "disabled", "false", "off"):
        raise InputError(f"MUJOCO_GL: got {choice!r}, which turns pictures off, want it unset")
    backend = choice or _installed()
    if not backend:
        raise InputError(f"OpenGL: got neither EGL nor OSMesa, want one of them to draw pictures: {INSTALL}")
    # PyOpenGL and the drivers raise what they like, AttributeError and TypeError included.
    try:
        from mujoco.rendering.classic import gl_context

        if backend in ("egl", "osmesa"):
            gl_context.GLContext = importlib.import_module(f"mujoco.{backend}").GLContext
        gl_context.GLContext(16, 16).free()
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"OpenGL: got {backend}, which fails ({reason}), want a working one: {INSTALL}") from error


def available() -> bool:
    """Whether pictures can be drawn here; if not, `bind` says why."""
    try:
        bind()
    except InputError:
        return False
    return True


def _installed() -> str:
    """The first backend whose libraries are there, or an empty string. PyOpenGL's EGL needs an OpenGL library too."""
    if find_library("EGL") and (find_library("OpenGL") or find_library("GL")):
        return "egl"
    return "osmesa" if find_library("OSMesa") else ""
