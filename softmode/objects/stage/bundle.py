"""A `ReducedBody` as attributes of a prim: one flat array for each array field, and a header in JSON for the rest.

Nothing is rounded and nothing is pickled: arrays keep their dtype, and JSON gives floats back to the bit. The signs of
zeros, which crate files drop where they compress an array, are in the header. A sha256 over all of it goes along, so
that a body of which a part was edited or lost in a conversion is told from a whole one.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.body.reduced_body import FORMAT, READABLE, ReducedBody
from softmode.errors import AssetError
from softmode.foreign import tokens

DTYPES = {"<f8": "double[]", "<f4": "float[]", "<i8": "int64[]"}
"""What fields may be made of, and the OpenUSD types of their attributes."""
_HINT = (
    "Write the file again with softmode.usd.write_usd, or delete its softmode: attributes to have the body built anew"
)


def content_digest(header: str, arrays: Mapping[str, NDArray]) -> str:
    """Return the sha256, in hexadecimal, of a header and arrays."""
    digest = hashlib.sha256(header.encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f";{name} {array.dtype.str} {array.size};".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def encode_body(body: ReducedBody) -> tuple[str, dict[str, NDArray], str]:
    """Return the header, the arrays by field, flat in C order, and the digest of both."""
    fields, arrays = body.fields()
    fields["arrays"] = {name: [array.dtype.str, list(array.shape)] for name, array in arrays.items()}
    flat = {name: np.ascontiguousarray(array).reshape(-1) for name, array in arrays.items()}
    zeros = {name: np.flatnonzero((array == 0.0) & np.signbit(array)).tolist() for name, array in flat.items()}
    fields["negative_zeros"] = {name: where for name, where in zeros.items() if where}
    header = json.dumps(fields)
    return header, flat, content_digest(header, flat)


def decode_body(header: str, arrays: Mapping[str, NDArray], digest: str, source: str) -> ReducedBody:
    """Return the body that `encode_body` was given, equal to the bit.

    Args:
        header: The header.
        arrays: The arrays by field, flat; a field that is not there is an empty one.
        digest: What the file says of their content.
        source: File and prim, for messages.

    Raises:
        AssetError: If anything was changed, is missing, or belongs to another version.
    """
    try:
        fields = json.loads(header)
        described = {str(name): (np.dtype(kind), tuple(shape)) for name, (kind, shape) in fields.pop("arrays").items()}
        zeros = {str(name): np.array(where, np.int64) for name, where in fields.pop("negative_zeros", {}).items()}
        unknown = [kind.str for kind, _ in described.values() if kind.str not in DTYPES]
        if unknown or not all(isinstance(n, int) and n >= 0 for _, shape in described.values() for n in shape):
            raise ValueError(f"arrays of {unknown or 'negative size'}")
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError, RecursionError) as error:
        raise AssetError(f"{source}: its softmode body has no readable header ({error})", hint=_HINT) from error
    flat = {name: np.zeros(0, kind) for name, (kind, _) in described.items()}
    flat.update({name: np.array(array) for name, array in arrays.items()})
    for name, where in zeros.items():
        array = flat.get(name, np.zeros(0))
        where = where[(where >= 0) & (where < array.size)] if array.dtype.kind == "f" else where[:0]
        array[where[array[where] == 0.0]] = -0.0
    if content_digest(header, flat) != digest:
        raise AssetError(f"{source}: its softmode body was changed since it was written", hint=_HINT)
    shaped: dict[str, NDArray] = {}
    for name, (kind, shape) in described.items():
        if flat[name].dtype != kind or flat[name].size != int(np.prod(shape, dtype=np.int64)):
            raise AssetError(f"{source}: {name} of its softmode body does not fit {kind} {shape}", hint=_HINT)
        shaped[name] = flat[name].reshape(shape).copy()
    if set(flat) != set(described):
        raise AssetError(f"{source}: its softmode body has arrays that its header does not name", hint=_HINT)
    if fields.pop("format", None) != FORMAT or fields.pop("version", None) not in READABLE:
        raise AssetError(f"{source}: its softmode body is of another version", hint=_HINT)
    return ReducedBody.from_fields(fields, shaped, source, hint=_HINT)


def body_of(attributes: Mapping[str, Any], source: str) -> ReducedBody:
    """Return the body that the attributes of a prim hold.

    Args:
        attributes: All attributes whose names begin with `softmode:`, arrays as they are in the file.
        source: File and prim, for messages.

    Raises:
        AssetError: If it was changed, is incomplete, or of another version.
    """
    version = attributes.get(tokens.FORMAT)
    if version != tokens.BUNDLE_FORMAT:
        raise AssetError(f"{source}: written as {version!r}, this softmode reads {tokens.BUNDLE_FORMAT!r}", hint=_HINT)
    texts = [attributes.get(name) for name in (tokens.BODY_HEADER, tokens.BODY_SHA256)]
    if not all(isinstance(text, str) for text in texts):
        raise AssetError(f"{source}: its softmode body has no header or no digest", hint=_HINT)
    arrays = {
        name.removeprefix(tokens.BODY_PREFIX): value.reshape(-1)
        for name, value in attributes.items()
        if name.startswith(tokens.BODY_PREFIX) and isinstance(value, np.ndarray)
    }
    return decode_body(str(texts[0]), arrays, str(texts[1]), source)
