"""What whole scenes cost and how right their matrices are: seconds in bare rays, told and found errors, images.

    python docs/whole_scenes.py [SCENE.xml ...] [--resolution 16] [--target 0.05] [--specular 0.1] [--basis texel]
                                [--rows 0] [--image]

A line of JSON for each scene, those of scenes_xml/whole if none is given. ``seconds`` are of ``prt.precompute`` with
``method="auto"`` in a process that did the same once before (``first_seconds``, with compilation); ``bare_seconds``
those of one occlusion ray per element above the horizon and nothing else; ``--rows`` vertices are compared with
Mitsuba's own render of their rows, and ``--image`` compares a picture by ``sparse_prt`` with one by ``path``. Each
scene has a process of its own. Nothing else should run beside it.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import warnings
from pathlib import Path
from typing import Any

import mi_sparse_prt as prt
from mi_sparse_prt.benchmark.direct_speed import BareOcclusion
from mi_sparse_prt.benchmark.measuring import timed
from mi_sparse_prt.benchmark.zoo import judge
from mi_sparse_prt.benchmark.zoo_rendering import ZooEffort, render_matrix, render_reference
from mi_sparse_prt.core.profiling import peak_memory
from mi_sparse_prt.core.worker_process import WorkerProcess
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.validation.validate import validate

WHOLE = Path(__file__).parents[1] / "scenes_xml" / "whole"
BLOCK = 1 << 23  # rays of the bare loop at a time


def bare_seconds(scene: prt.Scene, lighting: prt.CubemapLighting) -> float:
    """Of one occlusion ray per element above the horizon; the second pass, kernels compiled."""
    points = vertex_points(scene)
    bare = BareOcclusion(scene.unsplit, lighting, points)
    step = max(1, BLOCK // lighting.n_directions)

    def trace() -> None:
        for start in range(0, len(points), step):
            bare.count_visible(start, min(start + step, len(points)))

    trace()
    return timed(trace)[0]


def measure(
    path: Path, resolution: int, target: float, specular: float | None, basis: str, rows: int
) -> dict[str, Any]:
    """Times and errors of one scene's matrix."""
    lighting = prt.CubemapLighting(resolution)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", prt.PrtWarning)
        scene = prt.load_scene(path)
        bare = bare_seconds(scene, lighting)

        def precompute() -> prt.LightTransport:
            return prt.precompute(
                scene, lighting, basis=basis, target_error=target, specular_error=specular, progress=False
            )

        first, _ = timed(precompute)
        seconds, transport = timed(precompute)
        found = None
        if rows:
            found = validate(scene, transport, n_rows=rows, n_columns=128, progress=False, image=False).report
    return {
        "scene": path.stem,
        "resolution": resolution,
        "target": target,
        "specular_target": specular,
        "specular_noise": transport.report["specular_noise"],
        "parts": transport.report["estimated_error"]["parts"],
        "basis": basis,
        "rows": transport.shape[0],
        "first_seconds": first,
        "seconds": seconds,
        "bare_seconds": bare,
        "ratio": seconds / bare,
        "told": transport.report["estimated_error"]["total"],
        "found": found and found["relative_l2"]["total"],
        "noise": found and found["reference_noise"],
        "plan": str(transport.report["plan"]),
        "phases": transport.report["seconds"],
        "peak_gigabytes": peak_memory() / 1e9,
    }


def measure_image(path: Path, resolution: int, target: float) -> dict[str, Any]:
    """A picture by ``sparse_prt`` against one by ``path``, as the zoo's."""
    effort = ZooEffort(resolution=resolution, target_error=target)
    with WorkerProcess() as process:
        _, truth = process.call(render_reference, path, effort, seconds=600)
        outcome, ours = process.call(render_matrix, path, effort, seconds=600)
    report = judge(path.stem, ours, truth) if outcome == "done" else {"verdict": outcome, "sentences": [ours]}
    return {"scene": path.stem, "resolution": resolution, "image": report}


def main() -> None:
    """Print a line of each scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="*", metavar="SCENE.xml")
    parser.add_argument("--resolution", type=int, default=16)
    parser.add_argument("--target", type=float, default=0.05)
    parser.add_argument("--specular", type=float, help="specular_error, which target is then without")
    parser.add_argument("--basis", choices=("direction", "texel"), default="texel")
    parser.add_argument(
        "--rows", type=int, default=0, help="vertices to compare with Mitsuba's rows; none by default"
    )
    parser.add_argument("--image", action="store_true", help="compare pictures, in place of matrices")
    options = parser.parse_args()
    context = multiprocessing.get_context("spawn")
    for path in options.scenes or sorted(WHOLE.glob("*.xml")):
        arguments = path, options.resolution, options.target
        if options.image:
            print(json.dumps(measure_image(*arguments)), flush=True)
            continue
        with context.Pool(1) as pool:
            print(
                json.dumps(pool.apply(measure, (*arguments, options.specular, options.basis, options.rows))),
                flush=True,
            )


if __name__ == "__main__":
    main()
