"""Indirect light that half floats cannot hold."""

from types import SimpleNamespace

import numpy as np
import pytest

import mi_sparse_prt as prt
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.methods.brute_force import path_traced
from mi_sparse_prt.methods.half_floats import halved


@pytest.mark.parametrize("largest", [6e4, 99_472.0])
def test_light_too_large_for_half_floats(largest, tmp_path):
    """Rationale: a sharp lobe focuses light; 99,472 per steradian were met at alpha 0.001, and were stored as infinite.

    Expected: wider numbers from the block on in which they come up, no checkpoint of the two kinds mixed, and half
        floats as before where these do.
    """
    rows = np.random.default_rng(0).random((10, 24, 1), np.float32)
    rows[6, 3] = largest
    solver = SimpleNamespace(
        points=np.arange(10),
        lighting=prt.CubemapLighting(2),
        channels=1,
        block_size=4,
        rows=lambda ids: SimpleNamespace(mean=rows[ids]),
    )
    run = Run(0, progress=False, checkpoint_folder=tmp_path, state="x")
    part = path_traced(solver, prt.CubemapLighting(2), run)
    assert part.density.dtype == (np.float32 if largest > 65_504 else np.float16)
    assert part.density[6, 3] == pytest.approx(largest, rel=1e-3)
    np.testing.assert_allclose(part.density, rows, rtol=1e-3, atol=1e-7)
    assert list(tmp_path.iterdir()) == []
    assert halved(rows).dtype == part.density.dtype
