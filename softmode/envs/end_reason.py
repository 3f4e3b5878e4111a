"""Why an episode ended, on the host and in kernels."""

from enum import IntEnum


class EndReason(IntEnum):
    """Why an episode ended, ``info["end_reason"]``; what comes after TIME_LIMIT is a failure and terminates.

    The limit of a single environment is that of Gymnasium's ``TimeLimit`` around it, which info does not tell.
    """

    RUNNING = 0
    TIME_LIMIT = 1
    DIVERGED = 2
    """A number of the world's state was not finite."""
    DROPPED = 3
    """The object fell off the table."""
    SPILLED = 4
    """Another object left the container that it belongs in."""
    FAILED = 5
    """A rule of the task itself was broken: its `evaluate` wrote so."""
