"""An OpenGL context that needs no display, bound when the first picture is drawn.

On Linux MuJoCo chooses its OpenGL on import: a version that needs a display, unless MUJOCO_GL names another. With
MUJOCO_GL=egl and no EGL library even the import fails. Therefore nothing is chosen in advance. After the import, EGL,
or otherwise OSMesa, is put in place if its library is found. macOS and Windows have their own OpenGL.
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
    """Make sure that MuJoCo can draw without a display; a choice in MUJOCO_GL is kept."""
    if sys.platform != "linux":
        return
    choice = os.environ.get("MUJOCO_GL", "").strip().lower()
    if choice in ("0", "disable", "disabled", "false", "off"):
        raise InputError(f"MUJOCO_GL: got {choice!r}, which turns rendering off, want it unset")
    # The first that is installed. PyOpenGL's EGL also needs an OpenGL library.
    egl = find_library("EGL") and (find_library("OpenGL") or find_library("GL"))
    backend = choice or ("egl" if egl else "osmesa" if find_library("OSMesa") else "")
    if not backend:
        raise InputError(f"OpenGL: got neither EGL nor OSMesa, want one of them: {INSTALL}")
    # PyOpenGL and drivers raise exceptions of any kind, AttributeError and TypeError included.
    try:
        from mujoco.rendering.classic import gl_context

        if backend in ("egl", "osmesa"):
            gl_context.GLContext = importlib.import_module(f"mujoco.{backend}").GLContext
        context = gl_context.GLContext(16, 16)
        if backend not in ("egl", "osmesa"):  # those of windows only complain when something is drawn
            import mujoco

            context.make_current()
            mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), 100).free()
        context.free()
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        want = "MUJOCO_GL unset, or a working one" if choice else "a working one"
        raise InputError(f"OpenGL: got {backend}, which fails ({reason}), want {want}: {INSTALL}") from error


def missing() -> str:
    """Why no pictures can be drawn here, as `bind` raises it; empty if they can."""
    try:
        bind()
    except InputError as error:
        return str(error)
    return ""
