"""What the joint solve needs of MuJoCo besides ``SolverMuJoCo``: a step in two halves, what it dropped, warnings."""

import importlib
import warnings
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import newton
from newton.solvers import SolverMuJoCo

from softmode.deformables.model.compile_ahead import begin_compiling


class RigidSolver(SolverMuJoCo):
    """``SolverMuJoCo`` whose kernels begin to be compiled while it is built, as soon as MuJoCo's model is there.

    Newton launches one after another what it needs to build it. Without this, on a GPU, those kernels are compiled one
    after another, and those of a step after them. To be built within `compile_ahead.compiling_aside`.
    """

    _begun = False

    def notify_model_changed(self, flags: newton.ModelFlags | int) -> None:
        """Update MuJoCo's model; the first time, within the constructor, begin to compile what it and a step launch."""
        if not self._begun and not self.use_mujoco_cpu:
            self._begun = True
            begin_compiling(self._launches, self.model.device)
        super().notify_model_changed(flags)

    def _launches(self) -> None:
        """Launch what completes MuJoCo's model, and a step of its own."""
        import mujoco_warp

        mujoco_warp.set_const(self.mjw_model, self.mjw_data)
        mujoco_warp.step(self.mjw_model, self.mjw_data)


@contextmanager
def mujoco_warnings() -> Generator[None]:
    """Make Python's of the warnings of MuJoCo in C, which would write them to MUJOCO_LOG.TXT in the working folder.

    They are warned of at the end: an exception within MuJoCo's handler, as ``-W error`` raises, ends the process. A
    handler that someone else has set stays.

    Warns:
        RuntimeWarning: For each of them.
    """
    mujoco: Any = importlib.import_module("mujoco")
    if mujoco.get_mju_user_warning() is not None:
        yield
        return
    messages: list[str] = []
    mujoco.set_mju_user_warning(messages.append)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(None)
        for message in messages:
            warnings.warn(f"MuJoCo: {message}", RuntimeWarning, stacklevel=4)


def second_half(rigid: SolverMuJoCo) -> Callable[[], AbstractContextManager[None]]:
    """Return contexts within which ``rigid.step`` starts from MuJoCo's forces on, after a whole step from that state.

    Positions, inertia and constraint rows are then those of the whole step: MuJoCo's own split of a step, in
    ``mujoco_warp.step1`` and ``step2``. Newton offers none; a public hook would be an argument of
    ``SolverMuJoCo.step`` that says from which stage on MuJoCo computes, or a method that calls ``step2`` alone. Until
    then this function alone touches two private names of ``SolverMuJoCo``: the method ``_mujoco_warp_step``, replaced
    while a context lasts, and the flag ``_use_speculative_contacts``, with which that method does more than a step.
    Both are checked here, once; without them, and with integrators or options whose step has no such halves, a context
    changes nothing and the whole step is taken again.

    Warns:
        RuntimeWarning: If this version of Newton has not the names.
    """
    import mujoco_warp

    speculative = getattr(rigid, "_use_speculative_contacts", None)
    if not callable(getattr(rigid, "_mujoco_warp_step", None)) or not isinstance(speculative, bool):
        warnings.warn(
            "this version of Newton steps MuJoCo in another way than the one that softmode knows; steps in which soft "
            "bodies push rigid ones take two whole MuJoCo steps",
            RuntimeWarning,
            stacklevel=4,
        )
        return nullcontext

    @contextmanager
    def from_forces_on() -> Generator[None]:
        model, known = rigid.mjw_model, mujoco_warp.IntegratorType
        sleeps = bool(model.opt.enableflags & mujoco_warp.EnableBit.SLEEP)
        in_halves = model.opt.integrator in (known.EULER, known.IMPLICIT, known.IMPLICITFAST)
        whole = sleeps or not in_halves or speculative
        if not whole:
            vars(rigid)["_mujoco_warp_step"] = lambda: mujoco_warp.step2(model, rigid.mjw_data)
        try:
            yield
        finally:
            if not whole:
                del vars(rigid)["_mujoco_warp_step"]

    return from_forces_on


def dropping_overflows() -> int:
    """Return the bits of MuJoCo Warp's ``Data.overflow`` with which contacts or constraint rows are dropped."""
    from mujoco_warp import OverflowType as Kind

    return int(Kind.NEFC | Kind.NJMAX_NNZ | Kind.BROADPHASE | Kind.NARROWPHASE | Kind.CCD)
