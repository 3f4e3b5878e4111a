"""`Occupancy`: which object each slot of each world holds, what it may hold, and the rows of tables that follow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.materials.material import Material
from softmode.deformables.model.declare import launch
from softmode.deformables.tools.body_choice import copy_slots
from softmode.objects.config import ObjectConfig
from softmode.objects.loader import Progress, load
from softmode.objects.object_set import ObjectSet
from softmode.objects.soft_object import SoftObject
from softmode.scenes import occupancy_kernels as kernels
from softmode.splats.splats import Splats


class Occupancy:
    """Which object each slot of each world of a scene holds.

    The first `slots` soft bodies of a world are objects of the scene's set, or its one object; `others` follow them.
    With `ObjectSet.resample` a reset may put another object into a slot, or none: `draw` chooses, and `put` lets all
    arrays of `follow` have the rows of what was chosen.

    Args:
        thing: The object of every world, or what objects of the set are built like that are named.
        objects: The set; None where all worlds have the one object.
        others: What every world has behind its slots.
        material: What the object and the others are made of, and objects of the set that say nothing.
        world_count: Number of worlds.
        device: Warp device.
        progress: Reports the build of the objects.

    Attributes:
        choices: What a slot may hold: the one object, or those of the set that some world has; all with `resampled`.
        materials: What each of them is made of.
        names: What messages call each of them.
        others: Soft objects that every world has behind its slots.
        slots: How many objects of the set a world has room for.
        resampled: Whether a reset may change what a slot holds.
        choice: Which object of the set each slot holds, int32, shape (world_count * slots,), -1 for none; zeros without
            a set.
        by_world: The same memory, shape (world_count,), or (world_count, slots) where there are several.
        row: Which of `choices` the first slot of each world holds, int32, shape (world_count,), on the device.
    """

    def __init__(
        self,
        thing: ObjectConfig,
        objects: ObjectSet | None,
        others: Sequence[ObjectConfig],
        *,
        material: Material,
        world_count: int,
        device: wp.Device,
        progress: Progress,
    ) -> None:
        """Load what the worlds hold, each object once."""
        given = None if objects is None else objects.resolved(thing)
        self.world_count, self.device = world_count, device
        self.resampled = given is not None and given.resample
        chosen: NDArray[np.intp] = np.zeros(world_count, np.intp) if given is None else given.chosen(world_count)
        held, self._rows = np.unique(chosen, return_inverse=True)
        if given is None:
            kinds: list[tuple[ObjectConfig, Material | None]] = [(thing, material)]
            self.names: tuple[str, ...] = ("the object",)
        else:
            if self.resampled:
                held, self._rows = np.arange(given.count), chosen
            kinds = [(given.config(int(k)), given.material(int(k), material)) for k in held]
            self.names = tuple(f"objects: {given.names[k]}" for k in held)
        loaded: dict[tuple[ObjectConfig, Material | None], SoftObject] = {}

        def loaded_once(kind: ObjectConfig, own: Material | None) -> SoftObject:
            if (kind, own) not in loaded:
                loaded[kind, own] = load(kind, material=own, progress=progress)
            return loaded[kind, own]

        self.choices: tuple[SoftObject, ...] = tuple(loaded_once(kind, own) for kind, own in kinds)
        self.materials = tuple(
            made.material or own or material for made, (_, own) in zip(self.choices, kinds, strict=True)
        )
        self.others = tuple(loaded_once(kind, material) for kind in others)
        self._least, self.slots = (1, 1) if given is None else given.number_range
        shown = np.column_stack([chosen, np.full((world_count, self.slots - 1), -1)])
        self.choice = wp.array(shown.reshape(-1), dtype=int, device=device)
        self.by_world: wp.array = self.choice
        if self.slots > 1:
            self.by_world = self.choice.reshape((world_count, self.slots))
        self.row = wp.array(self._rows, dtype=int, device=device)
        self._ends = wp.array([1.0] if given is None else given.ends, dtype=float, device=device)
        self._wanted = wp.full(world_count * self.slots, int(kernels.DRAWN), dtype=int, device=device)
        self._followers: list[tuple[wp.array, wp.array, bool]] = []

    # -- what worlds hold ---------------------------------------------------------------------------------------------

    @property
    def chosen(self) -> NDArray[np.intp]:
        """Which object of the set each slot holds, on the host, shape (world_count, slots), -1 for none."""
        return self.choice.numpy().astype(np.intp).reshape(self.world_count, self.slots)

    @property
    def rows(self) -> NDArray[np.intp]:
        """Which of `choices` the first slot of each world holds, on the host, shape (world_count,)."""
        return self.chosen[:, 0] if self.resampled else self._rows

    @property
    def bodies(self) -> tuple[SoftObject, ...]:
        """The soft bodies of world 0 as it was made, one after another; instances of other worlds have its order."""
        return (*[self.choices[self._rows[0]]] * self.slots, *self.others)

    @property
    def shown(self) -> tuple[SoftObject | list[SoftObject], ...]:
        """The soft bodies of a world, a list with one per world where the first differs."""
        differs = len(self.choices) > 1 or self.resampled
        first: Any = [self.choices[row] for row in self.rows] if differs else next(iter(self.choices))
        return (*[first] * self.slots, *self.others)

    def objects_of(self, world: int) -> tuple[SoftObject, ...]:
        """Return the soft objects of a world, those that are there."""
        if self.slots == 1:
            return (self.choices[self.rows[world]], *self.others)
        return tuple(self.choices[c] for c in self.chosen[world] if c >= 0)

    def instances_of(self, world: int) -> tuple[int, ...]:
        """Return the instances of the solver that the soft objects of a world are, in the order of `objects_of`."""
        count = self.slots + len(self.others)
        there = range(count) if self.slots == 1 else np.flatnonzero(self.chosen[world] >= 0).tolist()
        return tuple(world * count + k for k in there)

    def drawn(self, draw: Callable[[SoftObject], Splats]) -> Splats | list[Splats]:
        """Return what is drawn for the first object: one for all, or one per world, or per choice where resets choose.

        Args:
            draw: Makes the splats of an object.
        """
        made = [draw(thing) for thing in self.choices]
        if self.resampled:
            return made
        return made[0] if len(made) == 1 else [made[row] for row in self.rows]

    @property
    def heights(self) -> NDArray[np.float64]:
        """Height of the centre of every unscaled object over the table at rest [m], shape (world_count, objects).

        Zero for an object that is not there.
        """
        heights = np.array([*(thing.height for thing in self.choices), 0.0])
        first = heights[self.chosen] if self.slots > 1 else heights[self.rows][:, None]
        others = np.array([thing.height for thing in self.others])
        return np.column_stack([first, np.tile(others, (self.world_count, 1))])

    # -- what follows -------------------------------------------------------------------------------------------------

    def follow(self, values: ArrayLike, dtype: Any = float, *, every_slot: bool = False) -> wp.array:
        """Return an array with a row per world: that of its object, which follows it where a reset may change it.

        Args:
            values: A row per choice.
            dtype: Type of the array, of a multiple of 32 bits.
            every_slot: Whether the second axis has an entry per slot, which follows the object there, and is zero where
                there is none. Else all follows the first.
        """
        table = np.asarray(values)
        array = wp.array(table[self.rows], dtype=dtype, device=self.device)
        if self.resampled:
            self._followers.append((wp.array(table, dtype=dtype, device=self.device), array, every_slot))
        return array

    def ask(self, wanted: NDArray[np.floating], mask: NDArray[np.bool_]) -> None:
        """Have the next `draw` take given objects in the masked worlds, shape (world_count, slots), -1 for none."""
        asked = np.where(mask[:, None], np.rint(wanted), int(kernels.DRAWN)).astype(np.int32)
        self._wanted.assign(asked.reshape(-1))

    def ask_nothing(self) -> None:
        """Have draws choose again."""
        self._wanted.fill_(int(kernels.DRAWN))

    def draw(self, world_mask: wp.array, seed: wp.array, episode: wp.array) -> None:
        """Draw what the slots of the masked worlds hold, where resets may change it; capturable.

        Args:
            world_mask: Which worlds, shape (world_count,) bool.
            seed: Seed of each world.
            episode: Which episode ended there.
        """
        if self.resampled:
            given = (world_mask, seed, episode, self._ends, self._least, self.slots, self._wanted)
            launch(self.device, kernels.draw_choice, self.world_count, *given, self.choice, self.row)

    def put(self, world_mask: wp.array) -> None:
        """Let all that follows have the rows of what the slots of the masked worlds hold; capturable."""
        for table, array, every_slot in self._followers:
            parts = [1] * self.slots if every_slot else None
            copy_slots(table, array, self.choice, world_mask, parts=parts)
