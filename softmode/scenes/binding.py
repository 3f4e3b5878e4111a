"""`BoundSplats`: the splats of soft bodies, moved by the states of a model with the kernels that cameras use."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import newton
import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.model.authoring import body_key
from softmode.deformables.model.declare import launch
from softmode.deformables.model.namespaces import soft
from softmode.deformables.skinning.skin_splats import SkinSplats
from softmode.deformables.skinning.skinning_kernels import vec6
from softmode.deformables.tools import body_choice_kernels as kernels
from softmode.deformables.tools.body_choice import copy_slots
from softmode.errors import ConfigError
from softmode.objects.soft_object import SoftObject
from softmode.scenes.host import host
from softmode.scenes.splat_axes_kernels import principal_axes
from softmode.splats.raster.rasterizer import SplatArrays, spanning_columns
from softmode.splats.splats import Splats

_ARRAYS = ("means", "covariances", "opacities", "sh", "rotations", "spanning")
"""Arrays of splats that may differ from world to world."""
_ROWS = 400_000
"""Most splats of states that are moved in one launch; bounds the memory."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SplatFrame:
    """The splats of one object in one world."""

    means: NDArray[np.float32]
    """Centres [m], shape (N, 3)."""
    covariances: NDArray[np.float32]
    """Covariances xx xy xz yy yz zz [m^2], shape (N, 6)."""

    def axes(self, device: wp.DeviceLike = None) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the principal axes: standard deviations [m] (N, 3), and unit quaternions xyzw to the world (N, 4)."""
        six = wp.array(np.ascontiguousarray(self.covariances, np.float32), dtype=vec6, device=device)
        scales = wp.zeros(six.shape, dtype=wp.vec3, device=device)
        quats = wp.zeros(six.shape, dtype=wp.quat, device=device)
        wp.launch(principal_axes, dim=six.shape, inputs=[six], outputs=[scales, quats], device=device)
        return host(scales), host(quats)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Skin:
    """The splats of one body in the worlds that have it."""

    skin: SkinSplats
    """The splats."""
    start: wp.array
    """Where q of the body begins in each of these worlds."""
    samples: wp.array
    """Where its surface samples begin, likewise."""
    rows: wp.array | None
    """The rows of these worlds in the arrays; None for all."""
    first: int
    """Column where they begin."""


class BoundSplats:
    """Splats that follow the soft bodies of a model: the mean of x(X) and F Sigma F^T over each splat.

    Args:
        model: A model with soft bodies, the same in every world; None for states of a single body on their own.
        objects: The soft bodies of a world in the order in which they were added, at least one; None for a body that is
            not shown; a list with one body per world of the model where worlds differ.
        worlds: Which worlds; all of them if None. Without a model: which states, the first if None.
        others: Splats behind those of the objects, which `update` leaves where they are: a marker, rigid toys; a list
            with one per world of the model where worlds differ.
        choices: Objects of which every soft body of a world may become any, see `choose`; lists in `others` then have
            one Splats per choice, and follow the first.
        choice: Which of them each world has, int32, shape (world_count,), or (world_count, objects), -1 for none.
        sh_degree: Highest degree of the colours, 0 to 3; None for that of the splats.
        device: Warp device where there is no model.

    Raises:
        ConfigError: If the model has other soft bodies, nothing has splats, or there is no model for several objects.
    """

    def __init__(
        self,
        model: newton.Model | None,
        objects: Sequence[SoftObject | Sequence[SoftObject] | None],
        *,
        worlds: Sequence[int] | None = None,
        others: Sequence[Splats | Sequence[Splats]] = (),
        choices: Sequence[SoftObject] = (),
        choice: wp.array | None = None,
        sh_degree: int | None = None,
        device: wp.DeviceLike = None,
    ) -> None:
        """Upload the splats at rest."""
        self._choice: Any = None if choice is None else choice.flatten()  # the same memory
        self._choices = tuple(choices)
        device = device if model is None else model.device
        each = [[thing] if thing is None or isinstance(thing, SoftObject) else list(thing) for thing in objects]
        self.indices = tuple(o for o, things in enumerate(each) if _has_splats(things))
        """Which objects have splats."""
        if model is not None:
            starts, samples = _starts(model, each, worlds)
        elif len(self.indices) == len(each) == len(each[0]) == 1 and each[0][0] is not None:
            state = np.array([0] if worlds is None else worlds)[:, None]
            starts, samples = state * each[0][0].body.function_count, state * each[0][0].body.surface_count
        else:
            raise ConfigError(f"there are {len(objects)} objects and no model", hint="give one object that has splats")
        chosen = range(len(starts)) if worlds is None else worlds
        if self._choices:
            chosen = range(len(self._choices))
        for part in others:
            if not isinstance(part, Splats) and len(part) <= max(chosen):
                hint = "give one Splats, or one for each world of the model"
                raise ConfigError(f"others has {len(part)} splats for world {max(chosen)}", hint=hint)
        parts: list[Splats | list[Splats]] = []
        for things in [each[o] for o in self.indices]:
            things = self._choices or things
            splats = [thing.visible_splats for thing in things if thing is not None]
            same = len(things) == 1 and not self._choices
            parts.append(splats[0] if same else [splats[w] for w in chosen])
        parts += [part if isinstance(part, Splats) else [part[w] for w in chosen] for part in others]
        count = len(self._choices) or len(starts)
        arrays = SplatArrays.from_splats(parts, world_count=count, sh_degree=sh_degree, device=device)
        if self._choices and len(each) > 1:
            widths = [max(part.count for part in splats) for splats in map(_listed, parts)]
            arrays = _one_row_each(arrays, count, widths)
        self.table = arrays
        """The splats at rest: of `choices` a row per choice, else `arrays`."""
        self._slots = len(each) if self._choices else 1
        rows = None if choice is None else self._choice.numpy()[:: self._slots].astype(np.int32)
        self.arrays = arrays if rows is None else _rows_of(arrays, rows)
        """The splats as they are, for cameras and rasterisers."""
        self._counts = [[part.count] if isinstance(part, Splats) else [one.count for one in part] for part in parts]
        ends = np.cumsum([max(counts) for counts in self._counts]).tolist()
        self.columns = tuple(slice(end - max(counts), end) for end, counts in zip(ends, self._counts, strict=True))
        """Where the splats of each object that has some are in `arrays`, then those of `others`; where worlds differ,
        the last columns of a world may be empty."""
        self._skins: list[_Skin] = []
        if self._choices:
            places = [
                {"start": _column(start, device), "samples": _column(first, device)}
                for start, first in zip(starts.T, samples.T, strict=True)
            ]
            for thing in self._choices:
                skin = _skin(thing, device)
                for place, columns in zip(places, self.columns, strict=False):
                    rows = wp.zeros(len(starts), dtype=int, device=device)
                    self._skins.append(_Skin(skin=skin, rows=rows, first=columns.start, **place))
            self.choose(wp.ones(len(starts), dtype=wp.bool, device=device))
            return
        for o, columns in zip(self.indices, self.columns, strict=False):
            things = each[o]
            for thing in {id(thing): thing for thing in things}.values():
                assert thing is not None  # of those that have splats
                skin = _skin(thing, device)
                mine = [k for k, w in enumerate(chosen) if things[w % len(things)] is thing]
                if not mine:
                    continue
                place = {"start": _column(starts[mine, o], device), "samples": _column(samples[mine, o], device)}
                rows = None if len(things) == 1 else wp.array(mine, dtype=int, device=device)
                self._skins.append(_Skin(skin=skin, rows=rows, first=columns.start, **place))

    def choose(self, world_mask: wp.array) -> None:
        """Show the objects that `choice` says in the masked worlds, shape (world_count,) bool; capturable."""
        if self._choice is None:
            return
        slots, worlds = self._slots, world_mask.shape[0]
        widths = [columns.stop - columns.start for columns in self.columns[:slots]]
        for name in _ARRAYS:
            table, array = getattr(self.table, name), getattr(self.arrays, name)
            if table is not array and table is not None:
                copy_slots(table, array, self._choice, world_mask, parts=widths if slots > 1 else None)
        for n, one in enumerate(self._skins):
            k, slot = divmod(n, slots)
            launch(self._choice.device, kernels.rows_that_chose, worlds, self._choice, slots, slot, k, one.rows)

    def update(self, state: newton.State) -> None:
        """Move the splats to where a state of the model has them; capturable after a first time."""
        self.move(soft(state).q, soft(state).dent)

    def move(self, q: wp.array, dent: wp.array | None = None) -> None:
        """Move the splats by the coordinates q of all instances [m], flat vec3d; capturable after a first time.

        Args:
            q: The coordinates.
            dent: Dents of the surface samples of all instances [m], flat vec3; None for none.
        """
        arrays = self.arrays
        moved, turns = (arrays.means, arrays.covariances), arrays.rotations
        for one in self._skins:
            where = {"rotations": turns, "first_splat": one.first, "rows": one.rows}
            one.skin.launch(q, one.start, *moved, dent=dent, sample_start=one.samples, **where)

    def frames(self) -> dict[tuple[int, int], SplatFrame]:
        """Return the splats as they are by place of the world in `worlds` and object; reads from the device.

        An object that is not there has none.
        """
        means, covariances = host(self.arrays.means), host(self.arrays.covariances)
        shown = np.tile(np.arange(len(means))[:, None], len(self.indices))
        if self._choice is not None:
            shown = self._choice.numpy().reshape(len(means), self._slots)
        frames: dict[tuple[int, int], SplatFrame] = {}
        for k, (o, columns, counts) in enumerate(zip(self.indices, self.columns, self._counts, strict=False)):
            for w in np.flatnonzero(shown[:, k] >= 0).tolist():
                mine = slice(columns.start, columns.start + counts[shown[w, k] % len(counts)])
                frames[w, o] = SplatFrame(means=means[w, mine].copy(), covariances=covariances[w, mine].copy())
        return frames


def splats_of_states(thing: SoftObject, states: ArrayLike, dents: ArrayLike | None = None) -> Iterator[Splats]:
    """Yield the splats of an object in each of its states, on the host.

    Args:
        thing: The object.
        states: Reduced coordinates [m], shape (F, n, 3).
        dents: Dents of its surface samples [m], shape (F, surface_count, 3); None for none.

    Raises:
        ConfigError: If there are dents of another shape.
    """
    q, rest = np.asarray(states, dtype=np.float64), thing.visible_splats
    given = None if dents is None else np.asarray(dents, dtype=np.float32)
    if given is not None and given.shape != (len(q), thing.body.surface_count, 3):
        hint = f"give one vector for each state and surface sample: {(len(q), thing.body.surface_count, 3)}"
        raise ConfigError(f"dents has shape {given.shape}", hint=hint)
    count = max(1, _ROWS // rest.count)
    for first in range(0, len(q), count):
        part = q[first : first + count]
        bound = BoundSplats(None, [thing], worlds=range(len(part)), device="cpu")
        left = None if given is None else wp.array(given[first : first + count].reshape(-1, 3), wp.vec3, device="cpu")
        bound.move(wp.array(part.reshape(-1, 3), dtype=wp.vec3d, device="cpu"), left)
        turns = bound.arrays.rotations.numpy()
        for (k, _), frame in bound.frames().items():
            # colours of degree 0 look the same from everywhere, and no rotations are computed for them
            yield rest.with_covariances(frame.means, frame.covariances, turns[k] if rest.sh_degree else np.eye(3))


def _listed(part: Splats | list[Splats]) -> list[Splats]:
    """Return the splats of a part, a list of one where all worlds show the same."""
    return [part] if isinstance(part, Splats) else part


def _one_row_each(table: SplatArrays, count: int, widths: Sequence[int]) -> SplatArrays:
    """Return arrays of which every one has a row per choice, so that one that is not there can be hidden.

    Args:
        table: Arrays of which some have one row for all.
        count: Number of choices.
        widths: Columns of each part; a shadow spans some of each, since any of them may be all that is there.
    """
    device = table.means.device
    starts = np.cumsum([0, *widths])
    spanning = np.concatenate([a + spanning_columns(n) for a, n in zip(starts, widths, strict=False)])

    def repeated(name: str) -> wp.array:
        array: wp.array = getattr(table, name)
        if array.shape[0] == count:
            return array
        return wp.array(np.repeat(array.numpy(), count, axis=0), dtype=array.dtype, device=device)

    named = {name: repeated(name) for name in ("opacities", "sh")}
    return replace(table, **named, spanning=wp.array(spanning[None], dtype=wp.int32, device=device))


def _rows_of(table: SplatArrays, rows: NDArray[np.int32]) -> SplatArrays:
    """Return arrays with some of the rows of others; those that all rows share stay as they are."""

    def chosen(name: str) -> Any:
        array: Any = getattr(table, name)
        if array is None or array.shape[0] != table.means.shape[0] or array.shape == (1, 1):
            return array
        return wp.array(array.numpy()[rows], dtype=array.dtype, device=array.device)

    return replace(table, **{name: chosen(name) for name in _ARRAYS})


def _has_splats(things: Sequence[SoftObject | None]) -> bool:
    """Return whether a body has splats; where worlds differ, all of them have, or it is shown in none."""
    return all(thing is not None and thing.splats is not None for thing in things)


def _skin(thing: SoftObject, device: wp.DeviceLike) -> SkinSplats:
    """Return the splats of an object at rest, and how they move."""
    rest, dents, count = thing.visible_splats, thing.dents, thing.body.surface_count
    seen: Any = {"near": dents.samples, "share": dents.weights, "sample_count": count, "device": device}
    return SkinSplats(rest.means, rest.covariances(), thing.basis, thing.grad_basis, **seen)


def _column(values: NDArray[np.integer], device: wp.DeviceLike) -> wp.array:
    """Return indices as an array of the device."""
    return wp.array(np.ascontiguousarray(values, dtype=np.int32), dtype=int, device=device)


def _starts(
    model: newton.Model, each: Sequence[Sequence[SoftObject | None]], worlds: Sequence[int] | None
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return where q and the surface samples of each soft body of a world begin, each of shape (worlds, bodies).

    Raises:
        ConfigError: If the worlds do not hold that many, or one of them holds another body.
    """
    data, count = soft(model), len(each)
    owner, every = data.instance_world.numpy(), max(int(model.world_count), 1)
    if len(owner) != every * count or (every > 1 and not np.array_equal(owner, np.repeat(np.arange(every), count))):
        hint = "give one object, or None, per soft body of a world, in the order in which they were added"
        raise ConfigError(f"objects names {count} soft bodies, the model has {len(owner)} in {every} worlds", hint=hint)
    starts, samples = (
        np.asarray(array.numpy(), dtype=np.int32).reshape(every, count)
        for array in (data.function_start, data.particle_start)
    )
    keys, chosen = data.body_key.numpy().reshape(every, count), range(every) if worlds is None else worlds
    for o, things in enumerate(each):
        if len(things) not in (1, every):
            hint = "give one body, or one per world"
            raise ConfigError(f"objects[{o}] has {len(things)} bodies for {every} worlds", hint=hint)
        wanted = [-1 if thing is None else body_key(thing.body) for thing in things]
        for w in chosen:
            wants = wanted[w % len(things)]
            if wants not in (-1, int(keys[w, o])):
                hint = "give the body of every world where worlds differ: TableScene.objects_of(world)"
                raise ConfigError(f"objects[{o}] is not the body that world {w} holds", hint=hint)
    return starts[list(chosen)], samples[list(chosen)]
