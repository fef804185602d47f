"""NumPy arrays on the device."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

PACKET = 16  # lanes of a processor, at most


def on_device(kind: Any, values: NDArray[Any]) -> Any:
    """A flat array as one of Dr.Jit, in memory that goes on after its end.

    Dr.Jit uses NumPy's memory as it is, and processors read it by whole packets. An array that ends where its page does
    would then end the process, now and then: the next page may be nobody's.

    Parameters
    ----------
    kind : type
        Such as ``mi.UInt32``; the values are of its type.
    values : (n,) array
    """
    longer = np.zeros(len(values) + PACKET, values.dtype)
    longer[: len(values)] = values
    return kind(longer[: len(values)])
