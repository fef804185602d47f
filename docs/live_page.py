"""Makes what the documentation's live page has inside: ``python docs/live_page.py`` from the root of the repository.

It keeps the archive alone (docs/live/terrace.txt); ``docs/conf.py`` puts today's page around it.
"""

from __future__ import annotations

import re
from pathlib import Path

import mi_sparse_prt as prt

ROOT = Path(__file__).parents[1]
ARCHIVE = Path(__file__).parent / "live" / "terrace.txt"
EDGE_LENGTH = 0.3
RESOLUTION = 16
KEPT = 0.03


def main() -> None:
    """A coarse terrace under one sky: less than a megabyte."""
    scene = prt.load_scene(ROOT / "scenes_xml" / "terrace.xml", EDGE_LENGTH)
    transport = prt.precompute(scene, prt.CubemapLighting(RESOLUTION), target_error=0.02)
    city = prt.load_environment(ROOT / "scenes_xml" / "envmaps" / "city.exr")
    page = prt.make_page(scene, prt.compress(transport, bases=12), {"city": city}, kept=KEPT)
    (data,) = re.findall(r'<script id="data" type="text/plain">([^<]*)</script>', page.text)
    ARCHIVE.parent.mkdir(exist_ok=True)
    ARCHIVE.write_text(data)
    print(f"{ARCHIVE.relative_to(ROOT)}: {len(data) / 1e3:.0f} kB, {scene.n_vertices} vertices")


if __name__ == "__main__":
    main()
