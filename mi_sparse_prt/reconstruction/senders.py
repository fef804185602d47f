"""Which glossy vertices send light by terms: large meshes have many vertices, and form factors of terms are dear."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mi_sparse_prt.measurement.vertices import Points
from mi_sparse_prt.reconstruction.node_placement import nodes_among
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.reflection.reflection import Reflection
from mi_sparse_prt.reflection.sent_light import SentLight, azimuths
from mi_sparse_prt.scene.scene import Scene

# Rows of terms that a matrix has, and of others, about: with twice as many, errors of three scenes were the same or a
# tenth less
ROWS = 80_000
NEIGHBOURS = 4  # senders from which a vertex takes light of other surfaces: 8 are no better


def choose_senders(
    scene: Scene, points: Points, seen: Reflection, sent: InOutFactors | None = None
) -> SentLight | None:
    """Light that surfaces send to each other, where that is not all that a matrix has rows for.

    Parameters
    ----------
    scene : Scene
    points : Points
        Of all vertices.
    seen : Reflection
        Of the matrix.
    sent : InOutFactors, optional
        With terms of surfaces as well that cameras' rays go on from.
    """
    every = sent or seen
    if not isinstance(every, InOutFactors):
        return None
    vertices, shown = np.arange(len(every.albedo)), seen.glossy
    near, weights = np.full((len(shown), NEIGHBOURS), -1), np.zeros((len(shown), NEIGHBOURS), np.float32)
    near[:, 0], weights[:, 0] = shown, 1
    if isinstance(seen, InOutFactors):
        turns = np.array([factors.turning is not None for factors in seen.factors])[seen.material[shown]]
        near[turns], weights[turns] = nodes_among(scene, points, shown[turns], ROWS // seen.terms, NEIGHBOURS)
    followed = np.setdiff1d(every.glossy, shown)
    nearest = vertices.copy()
    nearest[shown] = near[:, 0]
    most = ROWS // every.terms
    nearest[followed] = nodes_among(scene, points, followed, most, NEIGHBOURS).nodes[:, 0]
    senders = np.union1d(near, nearest[followed])
    nearest[senders[senders >= 0]] = senders[senders >= 0]
    if sent is None and np.array_equal(nearest, vertices):
        return None
    listed = nearest == vertices
    reflection = replace(every, material=np.where(listed, every.material, -1))
    listed[shown] = True
    whole = replace(every, material=np.where(listed, every.material, -1))
    return SentLight(reflection, whole, nearest, near, weights, azimuths(every, shown, near))
