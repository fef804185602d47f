"""Executes the notebooks with the settings in their first cells and stores small outputs in them, for the gallery.

``python docs/run_notebooks.py [NAME...]`` from the root of the repository; all of them take some minutes. Leave the
machine alone meanwhile: some print times.
"""

from __future__ import annotations

import base64
import io
import os
import sys
from pathlib import Path
from typing import Any

import nbclient
import nbformat
from PIL import Image

FOLDER = Path(__file__).parents[1] / "notebooks"
WIDEST = 1000  # pixels
COLOURS = 256


def main() -> None:
    """All notebooks, or those that are named."""
    os.environ["MPLBACKEND"] = "module://matplotlib_inline.backend_inline"
    for path in sorted(FOLDER.glob("*.ipynb")):
        if len(sys.argv) == 1 or path.stem in sys.argv[1:]:
            notebook = nbformat.read(path, as_version=4)
            client = nbclient.NotebookClient(
                notebook, timeout=1800, kernel_name="python3", resources={"metadata": {"path": str(FOLDER)}}
            )
            client.execute()
            notebook.metadata = {
                "kernelspec": notebook.metadata["kernelspec"],
                "language_info": {"name": "python"},
            }
            notebook.cells = [with_small_outputs(cell) for cell in notebook.cells]
            path.write_text(nbformat.writes(notebook) + "\n")
            print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB")


def with_small_outputs(cell: Any) -> Any:
    """A cell without progress bars, widgets and times of execution, its pictures in few colours."""
    cell.metadata.pop("execution", None)
    if cell.cell_type == "code":
        cell.execution_count = None
        cell.outputs = [
            output
            for output in cell.outputs
            if output.get("name") != "stderr"
            and "application/vnd.jupyter.widget-view+json" not in output.get("data", {})
        ]
        for output in cell.outputs:
            if "image/png" in output.get("data", {}):
                output.data["image/png"] = small_png(output.data["image/png"])
    return cell


def small_png(encoded: str) -> str:
    """A PNG, base64, of at most ``WIDEST`` pixels and ``COLOURS`` colours."""
    image = Image.open(io.BytesIO(base64.b64decode(encoded))).convert("RGB")
    if image.width > WIDEST:
        image = image.resize((WIDEST, image.height * WIDEST // image.width), Image.Resampling.LANCZOS)
    smaller = io.BytesIO()
    palette = image.quantize(COLOURS)
    image.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG).save(smaller, "PNG", optimize=True)
    return base64.b64encode(smaller.getvalue()).decode()


if __name__ == "__main__":
    main()
