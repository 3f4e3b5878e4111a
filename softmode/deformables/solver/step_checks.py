"""What a step refuses before it launches a kernel: steps that are no step, and states and controls of other models."""

from typing import Any

import newton

from softmode.checks import require_number
from softmode.deformables.model.namespaces import NAMESPACE, SoftControl, soft
from softmode.errors import ConfigError


def check_step(
    model: newton.Model, state_in: newton.State, state_out: newton.State, control: newton.Control | None, dt: float
) -> None:
    """Refuse what kernels would read beyond its end or turn into NaN; looks at shapes alone, so it may be captured.

    Args:
        model: The solver's model.
        state_in: State at the start of the step.
        state_out: State that the step writes.
        control: The step's control, or None.
        dt: Step [s].

    Raises:
        ConfigError: If ``dt`` is not finite and positive, or a state or the control belongs to another model.
    """
    require_number("dt", dt, above=0.0, unit="[s]", hint="take a step of 1 to 30 ms")
    own = soft(model)
    takes: list[tuple[str, Any]] = [("state_in", state_in), ("state_out", state_out)]
    if control is not None:
        takes.append(("control", control))
    for name, given in takes:
        data = getattr(given, NAMESPACE, None)
        if data is None:
            raise ConfigError(f"{name} holds no reduced body", hint=f"make it with {_MAKER[name]}")
        sizes: dict[str, tuple[int, int]] = {}
        if name == "control":
            sizes["functions"] = (len(data.q_driven), len(own.q_driven))
            sizes["pins"] = (_pin_count(data), _pin_count(own))
        else:
            sizes["functions"] = (len(data.q), len(own.q))
            sizes["particles"] = (given.particle_count, model.particle_count)
            sizes["rigid bodies"] = (given.body_count, model.body_count)
            sizes["joint coordinates"] = (given.joint_coord_count, model.joint_coord_count)
        wrong = [f"{a} {what} instead of {b}" for what, (a, b) in sizes.items() if a != b]
        if wrong:
            raise ConfigError(
                f"{name} belongs to another model: it has {', '.join(wrong)}",
                hint=f"make it with {_MAKER[name]} of the model that the solver was given",
            )


_MAKER = {"state_in": "model.state()", "state_out": "model.state()", "control": "model.control()"}


def _pin_count(data: SoftControl) -> int:
    """Return the number of pin targets; without pins a model has no such array."""
    targets = getattr(data, "pin_target", None)
    return 0 if targets is None else len(targets)
