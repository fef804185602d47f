"""Vertices that stand for their neighbours where these send light that is not diffuse: metals have many vertices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mi_sparse_prt.measurement.vertices import Points
from mi_sparse_prt.reconstruction.node_placement import nearest_nodes
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.reflection.reflection import Reflection
from mi_sparse_prt.reflection.sent_light import SentLight
from mi_sparse_prt.scene.scene import Scene

ROWS = 80_000  # of terms that no camera sees, about: with twice as many, errors were the same or a tenth less


def choose_senders(
    scene: Scene, points: Points, seen: Reflection, sent: InOutFactors, rows: int | None = None
) -> SentLight:
    """Light that is sent, with terms of surfaces that are followed at so many vertices that these have so many rows.

    Parameters
    ----------
    scene : Scene
    points : Points
        Of all vertices.
    seen : Reflection
        Of the matrix. What is glossy there keeps all its terms.
    sent : InOutFactors
        With terms of followed surfaces as well.
    rows : int, optional
        ``ROWS`` if not given.
    """
    followed = np.setdiff1d(sent.glossy, seen.glossy)
    senders = np.arange(len(sent.albedo))
    senders[followed] = nearest_nodes(scene, points, followed, (rows or ROWS) // sent.terms)
    material = np.where(senders == np.arange(len(senders)), sent.material, -1)
    return SentLight(replace(sent, material=material), senders)
