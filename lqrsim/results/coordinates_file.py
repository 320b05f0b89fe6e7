"""What of coordinates is in a file. `save_load.py` writes and reads them."""

from collections.abc import Mapping
from typing import Any

from lqrsim.results import schema
from lqrsim.results.coordinates import Coordinates

COORDINATES = schema.record({  # of the same names in Coordinates
    "names": schema.listed(schema.line), "units": schema.listed(schema.line), "position": schema.listed(schema.count),
    "angles": schema.listed(schema.count), "rotation_vectors": schema.listed(schema.count),
    "low": schema.listed(schema.any_number), "high": schema.listed(schema.any_number),
    "plane": schema.line, "offset": schema.optional(schema.number()),
})  # fmt: skip


def coordinates_of(texts: Mapping[str, Any]) -> Coordinates:
    """The coordinates of a file. Raises InputError for what are none."""
    given: dict[str, Any] = {name: tuple(one) if isinstance(one, list) else one for name, one in texts.items()}
    return Coordinates(**given)
