"""Bodies as headers and flat arrays, and as handles: exact both ways, and a change is told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pxr", reason="needs the extra [usd]")

from softmode.errors import AssetError
from softmode.objects import Placed, SoftObject
from softmode.objects.stage.bundle import body_of, decode_body, encode_body
from softmode.usd import read_usd_scene, write_usd
from softmode.usd.handles import (
    coordinates_from_handles,
    handle_weights,
    handles_from_coordinates,
    local_coordinates,
    rigid_motion,
    world_coordinates,
)
from tests.bodies import changed
from tests.usd.export_scenes import KINDS, assert_same, small_body, some_state


@pytest.mark.parametrize("kind", KINDS)
def test_round_trip_is_exact(kind: str) -> None:
    """Every field comes back to the bit, from flat arrays of which the empty ones may be missing."""
    body = small_body(kind)
    header, arrays, digest = encode_body(body)
    assert all(array.ndim == 1 for array in arrays.values())
    there = {name: array for name, array in arrays.items() if array.size}
    assert_same(decode_body(header, there, digest, "test"), body)


@pytest.mark.parametrize("suffix", [".usdc", ".usda"])
def test_signs_of_zeros_survive_the_file(suffix: str, tmp_path: Path) -> None:
    """A crate stores an array of whole or of few different numbers as such, -0.0 as 0.0; the body has its signs back.

    The normals of a box are such an array.
    """
    normals = small_body("affine").surface.normals.copy()
    axis = np.abs(normals).argmax(axis=1)
    normals = np.where(np.arange(3) == axis[:, None], np.sign(normals), -0.0)
    normals[::5] += 0.0
    body = changed(small_body("affine"), surface_normals=normals)
    header, arrays, digest = encode_body(body)
    lost = {name: array + 0.0 if array.dtype.kind == "f" else array for name, array in arrays.items()}
    assert_same(decode_body(header, lost, digest, "test"), body)
    write_usd(tmp_path / f"bar{suffix}", Placed(object=SoftObject(body=body)))
    (found,) = read_usd_scene(tmp_path / f"bar{suffix}").deformables
    assert found.bundle is not None
    assert_same(body_of(found.bundle, "test"), body)


@pytest.mark.parametrize("change", ["value", "missing", "extra", "header", "digest", "dtype", "nonsense", "zeros"])
def test_change_is_told(change: str) -> None:
    """What is not as it was written is refused, whichever part it is."""
    header, arrays, digest = encode_body(small_body("affine"))
    arrays = dict(arrays)
    if change == "value":
        arrays["points"] = np.nextafter(arrays["points"], np.inf)
    elif change == "missing":
        del arrays["weights"]
    elif change == "extra":
        arrays["other"] = np.zeros(3)
    elif change == "header":
        header = header.replace('"driven_count": 0', '"driven_count": 1')
    elif change == "digest":
        digest = digest[::-1]
    elif change == "dtype":
        arrays["points"] = arrays["points"].astype(np.float32)
    elif change == "zeros":
        header = header.replace('"negative_zeros": {', '"negative_zeros": {"points": [0, -9, 1e99], ')
    else:
        header = "[1, 2"
    with pytest.raises(AssetError, match="softmode body") as caught:
        decode_body(header, arrays, digest, "file /Body")
    assert "file /Body" in caught.value.message and caught.value.hint


@pytest.mark.parametrize("kind", KINDS)
def test_handles_move_points_as_the_functions_do(kind: str) -> None:
    """X + sum_j W_j [X, 1] M_j (and six monomials more) equals X + sum_k b_k q_k; the constant handle is last."""
    body = small_body(kind)
    q = some_state(body)
    x = body.cubature.points
    weight, gradient = handle_weights(body, x)
    assert (weight[:, -1] == 1.0).all() and (gradient[:, -1] == 0.0).all()
    matrices, quadratic = handles_from_coordinates(body, q)
    assert (matrices[:, :, 3] == 0.0).all()
    ones = np.concatenate([x, np.ones((len(x), 1))], axis=1)
    moved = x + np.einsum("pj,pi,jik->pk", weight, ones, matrices)[:, :3]
    if len(quadratic):
        squares = np.stack([x[:, a] * x[:, b] for a, b in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0))], axis=1)
        curved = [k for k in range(weight.shape[1]) if np.roll(body.handles.degrees, -1)[k] == 2]
        moved += np.einsum("pj,pi,jik->pk", weight[:, curved], squares, quadratic)
    rounding = 1e3 * np.finfo(float).eps * np.abs(matrices).max()  # raw functions cancel where they are many
    np.testing.assert_allclose(moved, x + body.evaluate(x)[0] @ q, atol=rounding)


@pytest.mark.parametrize("kind", KINDS)
def test_coordinates_come_back_from_handles(kind: str) -> None:
    """The matrices hold all of the state, one by one and as a sequence."""
    body = small_body(kind)
    states = np.stack([some_state(body), np.zeros((body.function_count, 3)), 2.0 * some_state(body)])
    handles = [handles_from_coordinates(body, q) for q in states]
    rounding = np.finfo(float).eps * np.linalg.cond(body.transform) * np.abs(states).max() * len(body.transform)
    again = coordinates_from_handles(body, np.stack([m for m, _ in handles]), np.stack([k for _, k in handles]))
    np.testing.assert_allclose(again, states, atol=rounding)
    np.testing.assert_allclose(coordinates_from_handles(body, *handles[0]), states[0], atol=rounding)
    assert not np.abs(handles[1][0]).any()  # at rest nothing is added


@pytest.mark.parametrize("kind", KINDS)
def test_frame_that_goes_along(kind: str) -> None:
    """A moved body is the rest body in the frame of its motion; of any state the frame changes only who looks."""
    body = small_body(kind)
    angle, scale = 2.0, 1.4
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    shift = np.array([0.4, 0.5, -0.6])
    placed = body.affine(scale * turn, shift)
    rotation, translation = rigid_motion(body, placed)
    np.testing.assert_allclose(rotation, turn, atol=1e-9)
    np.testing.assert_allclose(translation, shift, atol=1e-12)
    np.testing.assert_allclose(local_coordinates(body, placed, turn, shift, scale), 0.0, atol=1e-14)
    q = some_state(body)
    rotation, translation = rigid_motion(body, q)
    inside = local_coordinates(body, q, rotation, translation, scale)
    np.testing.assert_allclose(world_coordinates(body, inside, rotation, translation, scale), q, atol=1e-14)
    seen = body.cubature.points + body.evaluate(body.cubature.points)[0] @ inside
    there = body.cubature.points + body.evaluate(body.cubature.points)[0] @ q
    np.testing.assert_allclose(scale * seen @ rotation.T + translation, there, atol=1e-13)
    assert np.linalg.det(rotation) > 0.0
    assert np.linalg.det(rigid_motion(body, body.affine(np.diag([1.0, 1.0, -1.0])))[0]) > 0.0
