"""Colours of vertices that say what a matrix is made of, and the dense vertices that it remembers."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import build, made_up, still_life
from numpy.testing import assert_array_equal
from test_storage import rewritten

import mi_sparse_prt as prt
from mi_sparse_prt.methods import sparse as sparse_module
from mi_sparse_prt.methods.plan import Plan
from mi_sparse_prt.relighting.viewer.colourings import (
    DENSE,
    HELD,
    OTHERS,
    Colouring,
    cluster_ranks,
    colourings,
    in_page,
)
from mi_sparse_prt.sampling.consensus import Consensus

DATA = Path(__file__).parents[1] / "data"
LIGHTING = prt.CubemapLighting(8)
OPTIONS = {"spp": 4, "max_depth": 3, "progress": False}


@pytest.fixture(scope="module")
def scene():
    return build(0.2, **still_life())


@pytest.fixture(scope="module")
def sparse(scene):
    """A matrix by ``sparse``, and the dense vertices that the method had."""
    with pytest.MonkeyPatch.context() as patch:
        chosen, find = [], sparse_module.neighbourhoods

        def heard(sampler):
            dense, groups = find(sampler)
            chosen.append(dense.ids)
            return dense, groups

        patch.setattr(sparse_module, "neighbourhoods", heard)
        transport = prt.precompute(scene, LIGHTING, method="sparse", **OPTIONS)
    (ids,) = chosen
    return transport, np.sort(ids)


def test_dense_vertices_are_those_that_were_chosen(scene, sparse):
    transport, chosen = sparse
    assert_array_equal(transport.dense_vertices, chosen)
    assert 0.1 < len(chosen) / scene.n_vertices < 0.7


def test_dense_vertices_of_the_paper_stand_for_themselves(scene):
    """Their weights, in A of T = A D, are 1 at themselves; those of no other vertex are."""
    transport = prt.precompute(scene, LIGHTING, method="huang2010", **OPTIONS)
    weights = transport.operators["direct"].weights
    alone = (np.diff(weights.indptr) == 1) & (weights.max(axis=1).toarray().ravel() == 1)
    dense = transport.dense_vertices
    assert alone[dense].all()
    assert_array_equal(np.sort(weights[dense].indices), np.arange(weights.shape[1]))


def test_consensus_samples_some_vertices_themselves(scene, monkeypatch):
    asked, sample = [], Consensus.sample

    def heard(state, vertices):
        asked.append(vertices)
        sample(state, vertices)

    monkeypatch.setattr(Consensus, "sample", heard)
    plan = Plan("consensus", "gather")
    transport = prt.precompute(scene, LIGHTING, plan, max_depth=3, progress=False)
    assert_array_equal(transport.dense_vertices, np.unique(np.concatenate(asked)))
    assert 0.05 < len(transport.dense_vertices) / scene.n_vertices < 0.5


def test_all_alike_have_no_dense_vertices(scene):
    transport = prt.precompute(scene, prt.CubemapLighting(2), method="brute_force", **OPTIONS)
    assert transport.dense_vertices is None
    assert "all were sampled alike" in colourings(transport)["dense"]


def test_dense_vertices_survive_compression_and_files(sparse, tmp_path):
    """Expected: the same ids after each, and a file that is larger by at most 2%."""
    transport, chosen = sparse
    compressed = prt.compress(transport, progress=False)
    for number, made in enumerate((transport, compressed, prt.compress(transport, "haar", progress=False))):
        path = tmp_path / f"{number}.prt"
        made.save(path)
        loaded = prt.load_transport(path)
        assert_array_equal(loaded.dense_vertices, chosen)
        assert loaded.dense_vertices.dtype == made.dense_vertices.dtype == np.int64
        without = tmp_path / f"{number} without.prt"
        replace(made, dense_vertices=None).save(without)
        assert prt.load_transport(without).dense_vertices is None
        assert path.stat().st_size <= 1.02 * without.stat().st_size


def test_dense_vertices_follow_the_order_of_the_scene(scene, sparse):
    transport, chosen = sparse
    shuffled = build(0.2, **dict(reversed(still_life().items())))
    other = transport.for_scene(shuffled)
    keys = transport.measurement.keys[chosen]
    assert_array_equal(np.sort(other.measurement.keys[other.dense_vertices]), np.sort(keys))
    assert not np.array_equal(other.dense_vertices, chosen)


def test_files_without_them_are_read(tmp_path):
    old = prt.load_transport(DATA / "version_6_0.prt")
    assert old.dense_vertices is None and "older" in colourings(old)["dense"]
    transport = replace(made_up("bits"), dense_vertices=np.array([1, 5]))
    transport.save(tmp_path / "a.prt")
    path = rewritten(
        tmp_path / "a.prt",
        tmp_path / "b.prt",
        lambda name, content: None if name.startswith("dense_vertices/") else content,
    )
    assert prt.load_transport(path).dense_vertices is None


def test_vertices_that_are_not_there_are_refused(tmp_path):
    replace(made_up("bits"), dense_vertices=np.array([1, 1000])).save(tmp_path / "a.prt")
    with pytest.raises(prt.PrtError, match="damaged"):
        prt.load_transport(tmp_path / "a.prt")


def test_ranks_are_vectors_that_matter():
    """Clusters with vectors of known energies. Expected: as many as hold 95%, whatever their order; none where dark."""
    plain = made_up("clusters").operators["compressed"]
    vectors, clusters = plain.bases.shape[1], len(plain.means)
    energies = np.zeros((clusters, vectors))
    energies[1, 2], energies[2] = 7.0, 1.0  # one vector alone; all alike
    energies[3, :2] = (HELD - 0.02) / (1 - HELD + 0.02), 1.0  # the larger one holds 93%
    labels = np.arange(len(plain.labels)) % clusters
    counts = np.bincount(labels)
    sizes = np.sqrt(energies[labels] / counts[labels][:, None] / plain.coefficients.shape[1])
    coefficients = np.broadcast_to(sizes[:, None], plain.coefficients.shape).astype(np.float16)
    operator = replace(plain, labels=labels.astype(np.uint16), coefficients=coefficients)
    assert cluster_ranks(operator).tolist() == [0, 1, vectors, 2]


def test_colours_say_what_they_are_of(scene, sparse):
    transport, chosen = sparse
    assert set(colourings(transport)) == {"clusters", "rank", "dense"}
    assert "compress" in colourings(transport)["clusters"] and "compressed" in colourings(transport)["rank"]
    compressed = prt.compress(transport, clusters=6, bases=10, progress=False)
    found = colourings(compressed)
    operator = compressed.operators["compressed"]
    count = len(operator.means)
    assert found["clusters"].legend == f"{count} clusters"
    assert len(np.unique(found["clusters"].colours, axis=0)) == count
    ranks = cluster_ranks(operator)
    assert found["rank"].legend.startswith(f"{ranks.min()} (dark) to {ranks.max()} (bright) of 10 basis")
    brightness = found["rank"].colours.astype(int).sum(axis=1)
    own = ranks[operator.labels]
    assert brightness[own == ranks.max()].min() > brightness[own == ranks.min()].max()
    bright = (found["dense"].colours == DENSE).all(axis=1)
    assert_array_equal(np.flatnonzero(bright), chosen)
    assert (found["dense"].colours[~bright] == OTHERS).all()
    order = np.arange(scene.n_vertices)[::-1]
    arrays, words = in_page(found, order)
    assert_array_equal(arrays["denseColours"], found["dense"].colours[order])
    assert set(words["legends"]) == {"clusters", "rank", "dense"} and not words["unknown"]


def test_terms_have_the_colours_of_their_vertices():
    """A glossy vertex has several rows in one cluster. Expected: a colour for each vertex, that of its cluster."""
    glossy = prt.load_transport(DATA / "version_6_glossy_clusters.prt")
    labels, count = glossy.operators["compressed"].labels, len(glossy.measurement)
    assert len(labels) > count
    found = colourings(glossy)
    for name in ("clusters", "rank"):
        assert found[name].colours.shape == (count, 3)
    _, of_colours = np.unique(found["clusters"].colours, axis=0, return_inverse=True)
    for cluster in np.unique(labels[:count]):
        assert len(np.unique(of_colours.ravel()[labels[:count] == cluster])) == 1


def test_ranks_of_wavelets_are_counts(sparse):
    compressed = prt.compress(sparse[0], "haar", progress=False)
    rank = colourings(compressed)["rank"]
    assert isinstance(rank, Colouring)
    operator = compressed.operators["compressed"]
    counts = np.diff(operator.starts).reshape(len(operator.scales), -1).sum(axis=1)
    assert rank.legend.startswith(f"{counts.min()} (dark) to {counts.max()} (bright) wavelet coefficients")
    assert "clusters" in colourings(compressed)["clusters"]
