"""Names of what a segmentation shows: splat objects first, then the shapes of the model, alike in every world."""

from collections import Counter

import newton
import numpy as np
from numpy.typing import NDArray


def segmentation_table(model: newton.Model, object_names: tuple[str, ...]) -> tuple[NDArray[np.int32], tuple[str, ...]]:
    """Return the segmentation id of every shape of the model, shape (shape_count,), and the label of every id.

    Ids 0..O-1 are splat objects. The shapes follow; the same shape has the same id in every world, that is shapes
    whose label and place among those of that label in their world are equal. The label of a shape is that of its body
    and its own, "hand/shape_2", or "world/..." without a body.

    Args:
        model: The model.
        object_names: Label of each of the O splat objects.
    """
    shape_body, shape_world = model.shape_body, model.shape_world
    bodies = [] if shape_body is None else shape_body.numpy()
    worlds = [] if shape_world is None else shape_world.numpy()
    labels, known = list(object_names), {}
    table = np.zeros(model.shape_count, dtype=np.int32)
    seen: Counter[tuple[int, str]] = Counter()
    for index, own in enumerate(model.shape_label):
        carrier = "world" if bodies[index] < 0 else str(model.body_label[bodies[index]])
        label = own if own.startswith(f"{carrier}/") else f"{carrier}/{own}"
        # Shapes of no world are told apart from those of a world with the same label.
        world = int(worlds[index])
        key = (world < 0, label, seen[(world, label)])
        seen[(world, label)] += 1
        if key not in known:
            known[key] = len(labels)
            labels.append(label)
        table[index] = known[key]
    return table, tuple(labels)
