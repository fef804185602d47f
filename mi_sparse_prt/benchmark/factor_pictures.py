"""In-out factors of a BRDF as pictures: hemispheres seen from above."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from mi_sparse_prt.reflection.brdf_factors import BrdfFactors

SIZE = 160  # pixels of a hemisphere


def factor_picture(factors: BrdfFactors) -> Figure:
    """Incident factors f_k above, outgoing ones g_k (mean of their channels) below; blue is negative.

    A direction is at its x and y, so that the rim is the horizon; each picture has its own scale.
    """
    axis = np.linspace(-1, 1, SIZE)
    x, y = np.meshgrid(axis, -axis)
    inside = x**2 + y**2 < 1
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 1e-6))
    every = np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32)
    rows = factors.incident, factors.outgoing.mean(axis=1)
    figure = Figure(figsize=(2.1 * factors.terms, 4.6), layout="constrained")
    panels = figure.subplots(2, factors.terms, squeeze=False)
    for side, (line, tables) in enumerate(zip(panels, rows, strict=True)):
        for k, axes in enumerate(line):
            values = factors.grid.interpolate(tables[k], every).reshape(SIZE, SIZE)
            largest = max(float(np.abs(values[inside]).max()), 1e-12)
            shown = np.where(inside, values, np.nan)
            axes.imshow(shown, cmap="RdBu_r", vmin=-largest, vmax=largest)
            axes.set_title(f"{'fg'[side]}{k + 1}, up to {largest:.2g}", fontsize=9)
            axes.axis("off")
    return figure
