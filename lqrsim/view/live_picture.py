"""A picture of a run that goes on: opened with the first frame, and drawn anew for each that comes."""

import contextlib
from collections.abc import Callable

import numpy as np

from lqrsim.errors import Array, InputError
from lqrsim.results.rollout import Rollout
from lqrsim.view.picture import Picture, PictureOptions, open_picture
from lqrsim.view.text_tiles import Pixels


class LivePicture:
    """Draws one trial, with its plan.

    Args:
      camera, size: as in `render`, but "chase", which needs to know where the robot will go.

    Raises:
      InputError: a size or a text is wrong, or that camera.
    """

    def __init__(self, camera: str, size: tuple[int, int]) -> None:
        if camera == "chase":
            raise InputError("camera: got 'chase', want one that does not look ahead, such as 'overview' or 'top'")
        self._options = PictureOptions(camera=camera, overlays=("plan",), quality="draft", size=size)
        self._stack = contextlib.ExitStack()
        self._picture: Picture | None = None

    def draw(self, so_far: Callable[[], Rollout], frame: Array, time: float) -> Pixels:
        """The picture (height, width, 3) with MuJoCo's qpos at `frame` (nq,).

        Args:
          so_far: the run that it is of, asked for when the picture is opened.

        Raises:
          InputError: there is no such camera, or no OpenGL.
        """
        if self._picture is None:
            self._picture = self._stack.enter_context(open_picture(so_far(), self._options))
        for part in self._picture.parts:
            part.recorded.frame_times, part.recorded.frames = np.array([time]), frame[None]
        return self._picture.draw(time)

    def close(self) -> None:
        """Free the OpenGL context."""
        self._picture = None
        self._stack.close()
