"""What the joint solve needs of MuJoCo besides ``SolverMuJoCo``: a step in two halves, what it dropped, warnings."""

import importlib
import warnings
from collections.abc import Callable, Generator
from contextlib import contextmanager
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


class Halves:
    """MuJoCo's own split of a step, for ``rigid.step``.

    ``mujoco_warp.step1`` finds positions, inertia, constraint rows and what follows from velocities, ``step2`` forces
    and accelerations. Newton offers no split; a public hook would be an argument of ``SolverMuJoCo.step`` that says
    which stages MuJoCo computes. Until then this class alone touches two private names of ``SolverMuJoCo``: the method
    ``_mujoco_warp_step``, replaced while a context lasts, and the flag ``_use_speculative_contacts``, with which that
    method does more than a step. Both are checked here, once; without them, and with integrators or options whose step
    has no such halves, every step is a whole one.

    Args:
        rigid: The solver whose steps are split.

    Warns:
        RuntimeWarning: If this version of Newton has not the names.
    """

    def __init__(self, rigid: SolverMuJoCo) -> None:
        """Check the names."""
        self._rigid = rigid
        speculative = getattr(rigid, "_use_speculative_contacts", None)
        known = callable(getattr(rigid, "_mujoco_warp_step", None)) and isinstance(speculative, bool)
        self._whole = not known or bool(speculative)
        if not known:
            warnings.warn(
                "this version of Newton steps MuJoCo in another way than the one that softmode knows; steps in which "
                "soft bodies push rigid ones take two whole MuJoCo steps",
                RuntimeWarning,
                stacklevel=4,
            )

    @property
    def known(self) -> bool:
        """Whether a step has halves, with MuJoCo's present options."""
        import mujoco_warp

        options, integrators = self._rigid.mjw_model.opt, mujoco_warp.IntegratorType
        sleeps = bool(options.enableflags & mujoco_warp.EnableBit.SLEEP)
        in_halves = options.integrator in (integrators.EULER, integrators.IMPLICIT, integrators.IMPLICITFAST)
        return in_halves and not sleeps and not self._whole

    @contextmanager
    def both(self, between: Callable[[], None]) -> Generator[None]:
        """Within it ``rigid.step`` calls ``between`` between the halves; where there are none, that is called first."""
        import mujoco_warp

        def halves() -> None:
            mujoco_warp.step1(self._rigid.mjw_model, self._rigid.mjw_data)
            between()
            mujoco_warp.step2(self._rigid.mjw_model, self._rigid.mjw_data)

        if not self.known:
            between()
            yield
            return
        with self._stepping_by(halves):
            yield

    @contextmanager
    def second(self) -> Generator[None]:
        """Within it ``rigid.step`` starts from MuJoCo's forces on, after a whole step from the same state."""
        import mujoco_warp

        if not self.known:
            yield
            return
        with self._stepping_by(lambda: mujoco_warp.step2(self._rigid.mjw_model, self._rigid.mjw_data)):
            yield

    @contextmanager
    def _stepping_by(self, step: Callable[[], None]) -> Generator[None]:
        """Let ``rigid.step`` call this for MuJoCo's step."""
        vars(self._rigid)["_mujoco_warp_step"] = step
        try:
            yield
        finally:
            del vars(self._rigid)["_mujoco_warp_step"]


def dropping_overflows() -> int:
    """Return the bits of MuJoCo Warp's ``Data.overflow`` with which contacts or constraint rows are dropped."""
    from mujoco_warp import OverflowType as Kind

    return int(Kind.NEFC | Kind.NJMAX_NNZ | Kind.BROADPHASE | Kind.NARROWPHASE | Kind.CCD)
