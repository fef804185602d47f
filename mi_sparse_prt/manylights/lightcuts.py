"""Lightcuts (Walter et al. 2005): each sample has clusters of its own, fine where an error might be seen.

A baseline of matrix row-column sampling ([HPB07] 5), for scenes that are diffuse.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.device_arrays import on_device
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.manylights.elements import LANES, Done, Elements, Floats
from mi_sparse_prt.manylights.light_tree import LightTree, build_light_tree, largest_values

VISIBLE = 0.02  # of a sample's light: smaller errors are not seen (Walter et al. 2005, 3)
MOST = 1000  # nodes of a cut, as published
TOGETHER = 4096  # samples whose cuts are in memory; below 2^16

Ids = NDArray[np.int64]


def lightcuts(
    elements: Elements,
    seed: int = 0,
    threshold: float = VISIBLE,
    done: Done = lambda _: None,
) -> Floats:
    """Sums (m, 3) of all columns, by cuts through a tree of lights.

    All nodes of a cut whose light may be more than ``threshold`` of the sample's are split at once, so that each round
    is one wavefront of rays; the paper splits the worst one, again and again.

    Parameters
    ----------
    elements : Elements
        Of a scene whose surfaces are diffuse.
    seed : int
        Of the representatives.
    threshold : float
    done : callable
        Is told how many samples more are done.

    Raises
    ------
    PrtError
        Some surface is not diffuse.
    """
    if not elements.surfaces.all_lambertian:
        raise PrtError("lightcuts know bounds for diffuse surfaces alone: take another method for this scene")
    m, n = elements.shape
    found = np.zeros((m, 3), np.float32)
    if not m or not n:
        return found
    tree = build_light_tree(elements.lights, np.random.default_rng(seed))
    for a in range(0, m, TOGETHER):
        part = np.arange(a, min(a + TOGETHER, m))
        found[part] = _Cuts(elements, tree, part).refined(threshold)
        done(len(part))
    return found


class _Cuts:
    """Cuts of some samples: pairs of sample and node, but for those that will not be split any more."""

    def __init__(self, elements: Elements, tree: LightTree, rows: Ids) -> None:
        self._elements, self._tree, self._rows = elements, tree, rows
        at = elements.samples.receivers(on_device(mi.UInt32, rows.astype(np.uint32)))
        side = dr.mulsign(at.si.sh_frame.n, mi.Frame3f.cos_theta(at.si.wi))
        parts = [at.si.p.numpy(), side.numpy(), at.weight.numpy()]
        self._receivers = np.ascontiguousarray(np.concatenate(parts).T, np.float32)
        self._settled, self._sizes = np.zeros((len(rows), 3)), np.zeros(len(rows), np.int64)
        self._samples, self._nodes = np.zeros(0, np.int64), np.zeros(0, np.int64)
        self._values, self._most = np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
        samples = np.repeat(np.arange(len(rows)), len(tree.roots))
        nodes = np.tile(tree.roots, len(rows))
        self._add(samples, nodes, self._estimates(samples, nodes))

    def refined(self, threshold: float) -> Floats:
        """The light of the samples (k, 3)."""
        while True:
            means = self._values @ np.full(3, 1 / 3, np.float32)
            total = self._settled.mean(axis=1) + np.bincount(self._samples, means, len(self._rows))
            split = self._most > threshold * total[self._samples]
            split &= (self._sizes < MOST)[self._samples]
            if not split.any():
                break
            self._split(split)
        for c in range(3):
            self._settled[:, c] += np.bincount(self._samples, self._values[:, c], len(self._rows))
        return self._settled.astype(np.float32)

    def _split(self, which: NDArray[np.bool_]) -> None:
        """Replace nodes by their children, one of which has the representative, and a share of what it sends."""
        samples, nodes, values = self._samples[which], self._nodes[which], self._values[which]
        self._samples, self._nodes = self._samples[~which], self._nodes[~which]
        self._values, self._most = self._values[~which], self._most[~which]
        self._sizes -= np.bincount(samples, minlength=len(self._sizes))
        tree = self._tree
        children = tree.children[nodes]
        second = tree.representatives[children[:, 1]] == tree.representatives[nodes]
        same = np.take_along_axis(children, second[:, None].astype(np.int64), 1)[:, 0]
        other = np.take_along_axis(children, 1 - second[:, None].astype(np.int64), 1)[:, 0]
        share = tree.intensities[same] / np.maximum(tree.intensities[nodes], 1e-300)
        self._add(samples, same, values * share[:, None].astype(np.float32))
        self._add(samples, other, self._estimates(samples, other))

    def _add(self, samples: Ids, nodes: Ids, values: Floats) -> None:
        """More pairs; lights are known already, and so are nodes that can send nothing."""
        self._sizes += np.bincount(samples, minlength=len(self._sizes))
        most = largest_values(self._tree, nodes, samples, self._receivers, self._elements.clamp)
        open_ = (self._tree.children[nodes, 0] >= 0) & (most > 0)
        for c in range(3):
            self._settled[:, c] += np.bincount(samples[~open_], values[~open_, c], len(self._settled))
        self._samples = np.concatenate([self._samples, samples[open_]])
        self._nodes = np.concatenate([self._nodes, nodes[open_]])
        self._values = np.concatenate([self._values, values[open_]])
        self._most = np.concatenate([self._most, most[open_]])

    def _estimates(self, samples: Ids, nodes: Ids) -> Floats:
        """What nodes send (k, 3), by their representatives."""
        tree, found = self._tree, np.empty((len(nodes), 3), np.float32)
        lights = tree.representatives[nodes]
        scale = tree.intensities[nodes] / np.maximum(tree.intensities[lights], 1e-300)
        order = np.argsort(samples.astype(np.uint16), kind="stable")  # rays that begin together
        for a in range(0, len(nodes), LANES):
            part = order[a : a + LANES]
            found[part] = self._elements.pairs(self._rows[samples[part]], lights[part])
        return found * scale[:, None].astype(np.float32)
