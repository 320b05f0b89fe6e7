"""Waiting for the solves of a live re-planner."""

import lqrsim as ls


def ready(planner: ls.types.LiveReplanner) -> None:
    """Wait for the answer that the planner's thread is at."""
    if planner._pending is not None:
        planner._pending[1].exception()
