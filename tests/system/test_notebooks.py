"""The notebooks run from top to bottom and draw; what they store for the documentation is small."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest

nbformat = pytest.importorskip("nbformat", reason="needs the extra `notebooks`")
nbclient = pytest.importorskip("nbclient", reason="needs the extra `notebooks`")

NOTEBOOKS = sorted((Path(__file__).parents[2] / "notebooks").glob("*.ipynb"))

LARGEST = 600_000  # bytes of a notebook with its outputs

# Small values for the cell tagged "parameters": the whole notebook in seconds
SETTINGS: dict[str, dict[str, Any]] = {
    "01_first_matrix": {
        "RESOLUTION": 4,
        "EDGE_LENGTH": 1e9,  # meshes as they are
        "SPP": 1,
        "INDIRECT_RESOLUTION": 2,
        "IMAGE_WIDTH": 48,
        "REFERENCE_ROWS": 4,
        "REFERENCE_COLUMNS": 4,
        "REFERENCE_SPP": 4,
        "IMAGE_SPP": 4,
    },
    "02_sparse_precomputation": {
        "RESOLUTION": 4,
        "EDGE_LENGTH": 2.0,
        "SPP": 1,
        "IMAGE_WIDTH": 96,
        "RADII": [0.1, 0.2],
        "RADIUS_VERTICES": 20,
        "DIRECTIONS": 20,
    },
    "03_time_against_error": {
        "SCENE": "cornell",
        "RESOLUTION": 2,
        "EDGE_LENGTH": 1e9,
        "REFERENCE_SPP": 16,
        "METHODS": ["k_means_columns", "gather"],
    },
    "04_glossy_and_compression": {
        "SCENE": "glossy_spot",
        "RESOLUTION": 4,
        "EDGE_LENGTH": 1e9,
        "TERMS": 2,
        "HARMONICS": 1,
        "DIFFUSE_SCENE": "cornell",
        "TARGET_ERROR": 0.2,
        "IMAGE_WIDTH": 96,
        "IMAGE_SPP": 2,
    },
    "05_moving_light": {
        "SCENE": "cornell",
        "EDGE_LENGTH": 1e9,
        "IMAGE_WIDTH": 96,
        "RESOLUTION": 8,
        "TARGET_ERROR": 0.2,
        "OTHERS": ["studio"],
        "FRAMES": 12,
        "STILL": 8,
        "SLOW": 4,
        "FAST": 9,
        "AFTER": 14,
    },
    "06_many_lights": {
        "SCENE": "leaves",
        "IMAGE_WIDTH": 48,
        "LIGHTS": 500,
        "ROWS": 12,
        "COLUMNS": 40,
        "SEEDS": 2,
    },
}

# What conftest.py does, for the process of a notebook: errors and BRDF factors of less effort than users have; and
# plans whose costs are measured at fewer vertices, and coarser figures, which are not drawn twice to crop them
LESS_EFFORT = """
import importlib
from functools import partial

from mi_sparse_prt.estimation.element_sampling import Effort
from mi_sparse_prt.estimation.held_out import held_out_error
from mi_sparse_prt.reflection.brdf_factors import DirectionGrid, factor_cache

pipeline = importlib.import_module("mi_sparse_prt.precompute")
pipeline.held_out_error = partial(held_out_error, effort=Effort(spp=64, specular_strata=4))
factor_cache.FactorOptions = partial(factor_cache.FactorOptions, grid=DirectionGrid(32, 64), pairs=1 << 15)
harmonics = importlib.import_module("mi_sparse_prt.reflection.brdf_factors.harmonics")
harmonics.DirectionGrid = partial(DirectionGrid, 32, 64)
pilot = importlib.import_module("mi_sparse_prt.planner.pilot")
pilot.VERTICES, pilot.TEXELS = 32, 4
importlib.import_module("matplotlib").rcParams["figure.dpi"] = 50
get_ipython().run_line_magic("config", "InlineBackend.print_figure_kwargs = {'bbox_inches': None}")
"""


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs_and_draws(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A notebook is executed as a reader does, with smaller settings.

    Rationale: a notebook shows the public names in use, and nothing else notices when one of them changes.
    Expected: no cell raises; every setting that is made smaller exists; at least one picture comes out, and it is
    not blank.
    Result: the pictures are kept under tests/artefacts.
    """
    notebook = nbformat.read(path, as_version=4)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = []
    _override(notebook, SETTINGS[path.stem])

    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    client = nbclient.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(path.parent)}}
    )
    client.execute()  # raises CellExecutionError with the cell and its traceback

    pictures = _pictures(notebook)
    assert pictures, "no figure"
    folder = Path(__file__).parents[1] / "artefacts"
    folder.mkdir(exist_ok=True)
    for k, png in enumerate(pictures):
        (folder / f"{path.stem}_{k}.png").write_bytes(png)
        pixels = matplotlib.image.imread(io.BytesIO(png))[..., :3]  # [row, column, rgb]
        colours = np.rint(255 * pixels).astype(np.int64) @ [
            65536,
            256,
            1,
        ]  # a number is sorted sooner than three
        assert len(np.unique(colours)) > 100, f"figure {k} is (nearly) blank"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_stored_outputs_are_small_and_have_pictures(path: Path) -> None:
    """The gallery of the documentation shows a notebook as it is stored; nothing is executed for it.

    Rationale: a notebook without outputs is no gallery, and one with large ones makes every clone slow.
    Expected: pictures, no errors, and at most 600 kB (`python docs/run_notebooks.py` stores them so).
    """
    notebook = nbformat.read(path, as_version=4)
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert _pictures(notebook), "no stored picture: python docs/run_notebooks.py"
    assert not [output for output in outputs if output.output_type == "error"]
    assert path.stat().st_size <= LARGEST


def test_a_failing_cell_is_noticed(tmp_path: Path) -> None:
    """The check itself: a cell that raises fails the run.

    Rationale: an executor that is told to allow errors would pass any notebook.
    Expected: CellExecutionError.
    """
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell("1 / 0")])
    client = nbclient.NotebookClient(
        notebook, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    )
    with pytest.raises(nbclient.exceptions.CellExecutionError, match="ZeroDivisionError"):
        client.execute()


def _override(notebook: Any, settings: dict[str, Any]) -> None:
    """Add a cell with other values behind the one tagged ``parameters``, which must have names for all of them."""
    tagged = [k for k, cell in enumerate(notebook.cells) if "parameters" in cell.metadata.get("tags", [])]
    assert len(tagged) == 1, 'one cell must have the tag "parameters"'
    names = {
        line.split("=")[0].strip() for line in notebook.cells[tagged[0]].source.splitlines() if "=" in line
    }
    assert set(settings) <= names, f"no such settings: {set(settings) - names}"
    lines = [f"{name} = {value!r}" for name, value in settings.items()]
    notebook.cells.insert(tagged[0] + 1, nbformat.v4.new_code_cell("\n".join(lines) + LESS_EFFORT))


def _pictures(notebook: Any) -> list[bytes]:
    """All PNGs among the outputs."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    return [base64.b64decode(o["data"]["image/png"]) for o in outputs if "image/png" in o.get("data", {})]
