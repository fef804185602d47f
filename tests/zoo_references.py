"""A reduced zoo: what ``path`` makes of some of its scenes, stored as two independent halves in tests/data/zoo.npz.

``python tests/zoo_references.py`` writes them again, after the scenes were changed. It takes a minute.
"""

from pathlib import Path

import numpy as np

from mi_sparse_prt.benchmark.zoo import ZOO
from mi_sparse_prt.benchmark.zoo_rendering import Pair, ZooEffort, render_reference

STORED = Path(__file__).parent / "data" / "zoo.npz"
SIZE = {"width": "48", "height": "36"}
EFFORT = ZooEffort(spp=128, passes=32, noise=0.003)
SCENES = (
    "bsdf_diffuse",
    "bsdf_onesided",
    "shape_obj",
    "shape_serialized",
    "shape_rectangle",
    "shape_cube",
    "texture_bitmap",
    "texture_bitmap_nearest",
    "texture_checkerboard",
    "texture_vertex_attribute",
    "emitter_constant",
    "emitter_envmap",
)


def stored(name: str) -> Pair:
    """Both halves (height, width, 3) of a scene's reference."""
    with np.load(STORED) as file:
        first, second = file[name].astype(np.float32)
    return first, second


def main() -> None:
    """Render and store all."""
    halves = {name: render_reference(ZOO / f"{name}.xml", EFFORT, **SIZE) for name in SCENES}
    np.savez_compressed(STORED, **{name: np.array(pair, np.float16) for name, pair in halves.items()})


if __name__ == "__main__":
    main()
