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
WORLD_RIGID_NOT_FINITE = 32
"""Status bit: a coordinate, pose or velocity of a rigid body is not finite; only a reset mends it."""
WORLD_RIGID_OVERFLOW = 64
"""Status bit: MuJoCo dropped contacts or constraint rows between rigid bodies, for which it had no room."""
WORLD_PARAMETER_RANGE = 128
"""Status bit: a parameter of a soft body is no number, infinite or outside the range of ``Material``, as one written
into ``model.softmode`` may be; a bit of ``PARAMETER_BITS`` says which."""
WORLD_PENETRATION = 256
"""Status bit: a body began a step deeper in what it touches than ``OVERLAP`` (0.05) of its size; what is deeper than
that is pushed out by as much as that a step."""
PARAMETER_BITS = {
    name: 1 << (16 + k)
    for k, name in enumerate(
        (
            *("youngs_modulus", "poissons_ratio", "density", "viscosity", "mass_damping", "friction", "scale"),
            *("contact_stiffness", "contact_radius", "material_model", "pin_stiffness", "pin_target", "q_driven"),
            *("shape_material_mu", "gravity"),
        )
    )
}
"""Status bits, set with ``WORLD_PARAMETER_RANGE``: which array of the model or its control holds what cannot be."""

REASONS = {
    WORLD_ITERATION_LIMIT: "iteration_limit",
    WORLD_NO_DESCENT: "no_descent",
    WORLD_CONTACT_OVERFLOW: "contact_overflow",
    WORLD_NOT_FINITE: "not_finite",
    WORLD_COLLAPSED: "collapsed",
    WORLD_RIGID_NOT_FINITE: "rigid_not_finite",
    WORLD_RIGID_OVERFLOW: "rigid_overflow",
    WORLD_PARAMETER_RANGE: "parameter_range",
    WORLD_PENETRATION: "penetration",
    **{bit: f"{name}_range" for name, bit in PARAMETER_BITS.items()},
}
"""Name of every status bit, as ``info`` of the environments gives it."""

REMEDIES = {
    WORLD_ITERATION_LIMIT: "shorten the step, or soften the pins and the contact",
    WORLD_NO_DESCENT: "shorten the step if it persists",
    WORLD_CONTACT_OVERFLOW: "raise contact_max",
    WORLD_NOT_FINITE: "look for huge loads, tiny masses",
    WORLD_COLLAPSED: "reduce the load, raise E or nu",
    WORLD_RIGID_NOT_FINITE: "look for NaN in drives, forces and teleported bodies; reset the world",
    WORLD_RIGID_OVERFLOW: "pass rigid=SolverMuJoCo(model, njmax=..., nconmax=...)",
    WORLD_PARAMETER_RANGE: "write parameters by set_parameters, which clamps them",
    WORLD_PENETRATION: "place bodies apart, shorten the step, or give contact_stiffness_per_area",
    **{bit: f"write finite values inside the range of {name}" for name, bit in PARAMETER_BITS.items()},
}
"""What to do about every status bit."""


def status_reasons(bits: int, *, remedies: bool = False) -> tuple[str, ...]:
    """Return the names of the status bits that are set, lowest bit first; empty where nothing went wrong.

    Args:
        bits: Status of one world.
        remedies: Whether to add what to do, as in "contact_overflow (raise contact_max)".

    Raises:
        ConfigError: If a bit is set that is no status bit.
    """
    if bits & ~sum(REASONS):
        raise ConfigError(
            f"bits must be a combination of {sorted(REASONS)}, got {bits}", hint="pass one world's status"
        )
    found = [bit for bit in REASONS if bits & bit]
    return tuple(f"{REASONS[bit]} ({REMEDIES[bit]})" if remedies else REASONS[bit] for bit in found)
