"""Status bits of a world: what went wrong in its steps, gathered until cleared."""

from softmode.errors import ConfigError

WORLD_ITERATION_LIMIT = 1
"""Status bit: Newton stopped at its iteration limit."""
WORLD_NO_DESCENT = 2
"""Status bit: the line search found no lower potential and the step was not yet small."""
WORLD_CONTACT_OVERFLOW = 4
"""Status bit: an instance had more contacts than its capacity; near ones were dropped first, then touching ones."""
WORLD_NOT_FINITE = 8
"""Status bit: the step produced a value that is not finite; the world kept its state at rest."""
WORLD_COLLAPSED = 16
"""Status bit: more than a tenth of a body is squeezed to less than a hundredth of its volume."""

REASONS = {
    WORLD_ITERATION_LIMIT: "iteration_limit",
    WORLD_NO_DESCENT: "no_descent",
    WORLD_CONTACT_OVERFLOW: "contact_overflow",
    WORLD_NOT_FINITE: "not_finite",
    WORLD_COLLAPSED: "collapsed",
}
"""Name of every status bit, as ``info`` of the environments gives it."""


def status_reasons(bits: int) -> tuple[str, ...]:
    """Return the names of the status bits that are set, lowest bit first; empty where nothing went wrong.

    Raises:
        ConfigError: If a bit is set that is no status bit.
    """
    if bits & ~sum(REASONS):
        raise ConfigError(
            f"bits must be a combination of {sorted(REASONS)}, got {bits}", hint="pass one world's status"
        )
    return tuple(name for bit, name in REASONS.items() if bits & bit)
