"""Typed errors of softmode: each says what is wrong and how to mend it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any


class SoftmodeError(Exception):
    """Base of all errors that softmode raises on purpose.

    Args:
        message: What is wrong; names the argument or the file, what was expected and what was given.
        hint: The remedy, as an imperative.
    """

    def __init__(self, message: str, *, hint: str = "") -> None:
        """Store the message and the remedy."""
        # What a file or a name brought in is shown, not obeyed by a terminal, and can be printed in any encoding.
        self.message, self.hint = (
            "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in text) for text in (message, hint)
        )
        super().__init__(self.message)

    def __str__(self) -> str:
        """Return the message followed by the remedy."""
        if not self.hint:
            return self.message
        return f"{self.message.rstrip('.')}. {self.hint[0].upper()}{self.hint[1:]}"


class AssetError(SoftmodeError, ValueError):
    """An asset (splat, mesh, saved body) cannot be read or holds no usable object."""


class MaterialError(SoftmodeError, ValueError):
    """A material parameter lies outside its admissible range."""


class BasisError(SoftmodeError, ValueError):
    """A reduced basis cannot be built or evaluated for the given points."""


class ConfigError(SoftmodeError, ValueError):
    """An option or argument is unknown or outside its range."""


class UnknownArgumentError(ConfigError, TypeError):
    """A keyword argument is unknown; a `TypeError` as well, by which other libraries find out what they may give."""


class GraspError(SoftmodeError, ValueError):
    """A gripper has no grasp of an object."""


class FitError(SoftmodeError, ValueError):
    """A film, markers or a force log do not show what an object is made of."""

    picture: Any = None
    """Of a film: what it shows, an image (H, W, 3) of bytes."""


class LanesError(SoftmodeError, TypeError):
    """A device function cannot be translated into code for eight points at a time, which CPUs run."""


class MissingExtraError(SoftmodeError, ImportError):
    """An optional dependency is absent."""


@contextlib.contextmanager
def needs_extra(extra: str, message: str, *, otherwise: str = "") -> Iterator[None]:
    """Turn a failed import in a block into the error that names the extra to install.

    Args:
        extra: The extra of softmode that brings the package.
        message: What needs which package.
        otherwise: What else helps, put behind the remedy.

    Raises:
        MissingExtraError: If the block raises ImportError.
    """
    try:
        yield
    except ImportError as error:
        raise MissingExtraError(message, hint=f"install it with: pip install 'softmode[{extra}]'{otherwise}") from error


class MemoryShortError(SoftmodeError, MemoryError):
    """More memory is asked for than there is."""


@contextlib.contextmanager
def memory_errors(what: str, *, size: int | None = None, hint: str = "ask for less") -> Iterator[None]:
    """Turn a MemoryError in a block into one that says what was asked for.

    Args:
        what: What needs the memory.
        size: How much [bytes], if the error does not tell, as NumPy's do.
        hint: The remedy.

    Raises:
        MemoryShortError: If the block raises MemoryError.
    """
    try:
        yield
    except Exception as caught:
        error: BaseException | None = caught
        while not (error is None or isinstance(error, MemoryError)):  # what failed after it may hide it
            error = error.__context__
        if error is None or isinstance(error, MemoryShortError):
            raise
        asked = str(error) or ("its size is not told" if size is None else f"{size / 1e9:.3g} GB were asked for")
        raise MemoryShortError(f"{what} takes more memory than there is: {asked}", hint=hint) from error


class StorageError(SoftmodeError, OSError):
    """A file cannot be written: no space is left, or the place may not be written to."""


class SolverDiverged(SoftmodeError, RuntimeError):
    """A step produced no finite state."""


class WorkerError(SoftmodeError, RuntimeError):
    """A process that holds worlds of a vector environment has died, was closed, or failed at something unexpected."""


class CheckpointError(SoftmodeError, ValueError):
    """A policy or checkpoint file is missing, damaged, foreign, or belongs to another environment or version."""


class StateError(SoftmodeError, ValueError):
    """A saved state is damaged, or belongs to another version, task, robot or object."""


class RunError(StorageError):
    """The folder of a training run exists, is missing, or cannot be written."""


class TrainingDiverged(SoftmodeError, RuntimeError):
    """Training met a value that is not finite."""


class EnvironmentCheckError(SoftmodeError, AssertionError):
    """A vector environment breaks a rule of Gymnasium's vector API.

    Args:
        message: What was seen and what the rule asks.
        rule: Name of the broken rule, one of `softmode.vector_check.RULES`.
        world: Index of the world at fault; None where no single world is.
        hint: The remedy.
    """

    def __init__(self, message: str, *, rule: str, world: int | None = None, hint: str = "") -> None:
        """Put rule and world before the message."""
        where = "" if world is None else f", world {world}"
        super().__init__(f"{rule}{where}: {message}", hint=hint)
        self.rule = rule
        self.world = world
