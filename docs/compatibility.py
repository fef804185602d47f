"""Puts what ``mi-sparse-prt benchmark --zoo`` found into docs/compatibility.md, and its pictures into docs/images.

    mi-sparse-prt benchmark --zoo --json zoo.json --figures zoo
    python docs/compatibility.py zoo.json zoo/zoo.png

The first takes some minutes.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "compatibility.md"
SHEET = ROOT / "docs" / "images" / "zoo.jpg"
BEGIN, END = "<!-- written by docs/compatibility.py -->\n", "<!-- end -->"
COLUMNS = ("scene", "verdict", "error", "noise may show", "its estimate", "time")
LONGEST = 160  # characters of a sentence in the table

sys.path.insert(0, str(ROOT / "scenes_xml" / "zoo"))

from make_zoo import LEFT_OUT  # noqa: E402

from mi_sparse_prt.cli.tables.zoo import verdict_words  # noqa: E402


def main() -> None:
    """Write the page's own part anew, and the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("report", type=Path)
    parser.add_argument("sheet", type=Path)
    options = parser.parse_args()
    before, _, rest = PAGE.read_text().partition(BEGIN)
    _, _, after = rest.partition(END)
    report = json.loads(options.report.read_text())
    PAGE.write_text(before + BEGIN + "\n".join(page(report)) + "\n" + END + after)
    picture = plt.imread(options.sheet)
    plt.imsave(SHEET, picture[..., :3], pil_kwargs={"quality": 85})


def page(report: dict[str, Any]) -> list[str]:
    """Lines of Markdown: the counts, a table of scenes, what was said of some, and plugins without a scene."""
    counts = ", ".join(f"{count} {verdict}" for verdict, count in report["counts"].items())
    numbers: dict[str, int] = {}  # of sentences
    rows = [table_row(scene, numbers) for scene in report["scenes"]]
    machine = report["machine"]
    times = f"Times are from {machine['cores']} cores under a load of {machine['load_average']:.1f}"
    return [
        "",
        f"{len(report['scenes'])} scenes: {counts}. {times}; above {machine['cores']}, others were working, too.",
        "",
        f"| {' | '.join(COLUMNS)} | |",
        "|" + "---|" * (len(COLUMNS) + 1),
        *rows,
        "",
        *(f"{number}. {sentence}" for sentence, number in numbers.items()),
        "",
        "Plugins without a scene: "
        + "; ".join(f"`{name}` {reason}" for name, reason in LEFT_OUT.items())
        + ".",
        "",
    ]


def table_row(scene: dict[str, Any], numbers: dict[str, int]) -> str:
    """A scene's line; sentences are numbered as they come, and said below the table."""
    shares = (scene[name] for name in ("error", "uncertainty", "estimated_error"))
    cells = [f"`{scene['name']}`", verdict_words(scene), *("" if s is None else f"{s:.1%}" for s in shares)]
    cells.append("" if scene["seconds"] is None else f"{scene['seconds']:.1f} s")
    said = scene["sentences"] if scene["verdict"] != "agrees" else []
    notes = [numbers.setdefault(shortened(sentence), len(numbers) + 1) for sentence in said]
    return f"| {' | '.join(cells)} | {', '.join(map(str, dict.fromkeys(notes)))} |"


def shortened(sentence: str) -> str:
    """A sentence of one line that is not too long, and that Markdown leaves as it is."""
    line = " ".join(sentence.split()).replace("<", "&lt;").replace("|", "\\|")
    return line if len(line) <= LONGEST else line[: LONGEST - 4] + " ..."


if __name__ == "__main__":
    main()
