"""In-out factors of BRDFs on the device, looked up at vertices."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.reflection.factor_tables import incident_tables, look_up
from mi_sparse_prt.reflection.frames import frames
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.solvers.form_factors import NOTHING

Floats = NDArray[np.float32]


class Lobes:
    """Incident and outgoing factors; 0 at vertices that are not glossy.

    Parameters
    ----------
    reflection : InOutFactors
    outgoing : (channels, materials, size, size, K) float32, optional
        g_k, where they are asked for.

    Attributes
    ----------
    terms : int
        K.
    """

    def __init__(self, reflection: InOutFactors, outgoing: Floats | None = None) -> None:
        n, tables, glossy = len(reflection.albedo), incident_tables(reflection.factors), reflection.glossy
        self._size, self.terms = tables.shape[1], reflection.terms
        material = np.full(n, len(tables), np.uint32)  # one more, which is dark
        material[glossy] = reflection.material[glossy]
        turn = np.zeros((n, 3, 3), np.float32)
        turn[glossy] = frames(reflection.tangents[glossy], reflection.normals[glossy])
        self._material, self._dark = mi.UInt32(material), len(tables)
        self._axes = [mi.Vector3f(np.ascontiguousarray(turn[:, k].T)) for k in range(3)]
        self._incident = _with_dark(tables)
        self._outgoing = [] if outgoing is None else [_with_dark(t) for t in outgoing]

    def is_glossy(self, vertex: mi.UInt32) -> mi.Mask:
        """Whether vertices have terms."""
        return dr.gather(mi.UInt32, self._material, vertex) != self._dark

    def incident(self, vertex: mi.UInt32, direction: mi.Vector3f) -> list[mi.Float]:
        """Terms f_k(w) pi / cos for directions (world) that are cosine-distributed."""
        local = self._local(vertex, direction, mi.Mask(True))
        scale = dr.pi / dr.maximum(local.z, 1e-2)
        return [scale * value for value in self._looked_up(self._incident, vertex, local, mi.Mask(True))]

    def outgoing(self, vertex: mi.UInt32, direction: mi.Vector3f) -> list[mi.Float]:
        """Terms g_k(w_o) of each channel in turn; ``vertex`` may be none."""
        valid = vertex < NOTHING
        local = self._local(vertex, direction, valid)
        valid &= local.z > 0
        return [v for table in self._outgoing for v in self._looked_up(table, vertex, local, valid)]

    def _local(self, vertex: mi.UInt32, direction: mi.Vector3f, valid: mi.Mask) -> mi.Vector3f:
        return mi.Vector3f(
            *(dr.dot(dr.gather(mi.Vector3f, axis, vertex, valid), direction) for axis in self._axes)
        )

    def _looked_up(
        self, table: mi.Float, vertex: mi.UInt32, local: mi.Vector3f, valid: mi.Mask
    ) -> list[mi.Float]:
        material = dr.gather(mi.UInt32, self._material, vertex, valid)
        return look_up(table, self._size, self.terms, material, local, valid)


def _with_dark(tables: Floats) -> mi.Float:
    dark = np.zeros_like(tables[:1])
    return mi.Float(np.concatenate([tables, dark]).ravel())
