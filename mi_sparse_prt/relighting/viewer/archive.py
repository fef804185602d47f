"""Arrays in one text, as a page reads them: a header in JSON, then arrays; all of it deflated, as base64."""

from __future__ import annotations

import base64
import json
import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

KINDS = ("|i1", "|u1", "<u2", "<i4", "<u4", "<f4")  # that the page knows


def packed(header: dict[str, Any], arrays: dict[str, NDArray[Any]], differences: frozenset[str]) -> str:
    """The archive.

    Parameters
    ----------
    header : dict
        JSON as it is.
    arrays : dict of name to array
        Of 8 bits, of 16 or 32 without a sign, of signed 32 or of float32. Shapes are not kept.
    differences : set of names
        Integers that are kept as differences from the one before, which deflate better.
    """
    listed, parts = [], []
    for name, array in arrays.items():
        values = np.ascontiguousarray(array).ravel()
        if name in differences:
            values = np.diff(values, prepend=values.dtype.type(0))
        kind = values.dtype.newbyteorder("<").str
        assert kind in KINDS, f"{name}: the page does not know {kind}"
        listed.append({"name": name, "dtype": kind, "size": len(values), "differences": name in differences})
        # bytes of one kind lie together: they are alike
        parts.append(values.astype(kind).view(np.uint8).reshape(len(values), -1).T.tobytes())
    words = json.dumps(header | {"arrays": listed}).encode()
    content = b"".join([struct.pack("<I", len(words)), words, *parts])
    return base64.b64encode(zlib.compress(content, 9)).decode()
