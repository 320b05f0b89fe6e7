"""Where the balls of a robot were in its runs, and should have been: what pictures of it need. NumPy only."""

from dataclasses import dataclass, fields

import numpy as np

from lqrsim.errors import Array, InputError, shaped


@dataclass(frozen=True, kw_only=True)
class BallRecord:
    """Of K trials of T control periods and B balls; the last ball stands for a robot without a position.

    Attributes:
      driven: (K, T+1, B, 3) their middles in the world, in metres; NaN where the states are. planned: (T+1, B, 3).
      radii: (B,) in metres.
      anchors: (B, 4) the body of the MJCF that a ball is fixed to, by its number, and where it is in its axes, in
        metres; NaN for a ball that names no site.
    """

    driven: Array
    planned: Array
    radii: Array
    anchors: Array

    def __post_init__(self) -> None:
        driven = shaped("BallRecord: driven", self.driven, (None, None, None, 3))
        _, knots, count, _ = driven.shape
        shapes = {"driven": driven.shape, "planned": (knots, count, 3), "radii": (count,), "anchors": (count, 4)}
        for field in fields(self):
            name = f"BallRecord: {field.name}"
            object.__setattr__(self, field.name, shaped(name, getattr(self, field.name), shapes[field.name]))
        if not count:
            raise InputError("BallRecord: radii: got none, want one a ball, at least one")
        if not (np.isfinite(self.planned).all() and (self.radii >= 0).all()):
            raise InputError("BallRecord: got NaN or negative numbers, want finite places planned and radii from 0")

    @property
    def tracked(self) -> tuple[int, Array]:
        """The body that the last ball is fixed to, and where on it, (3,).

        Raises:
          InputError: it names no site.
        """
        body, *place = self.anchors[-1].tolist()
        if not np.isfinite(body):
            raise InputError(
                "balls: got none of a site for the last of them, want sites= in CollisionSpheres with one for it"
            )
        return int(body), np.array(place)
