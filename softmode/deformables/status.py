"""Status bits of a world: what went wrong in its steps, gathered until cleared."""

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
