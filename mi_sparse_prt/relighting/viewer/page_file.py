"""A page in one file: HTML with its style, scripts and data inside."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from string import Template

from mi_sparse_prt.io.atomic import write_atomically


@dataclass(frozen=True, repr=False)
class PageFile:
    """A page that needs nothing else, and no network.

    Attributes
    ----------
    text : str
        HTML.

    Notes
    -----
    As the last line of a notebook's cell it is shown there.
    """

    text: str

    def save(self, path: str | Path) -> None:
        """Write the page as a file, whole or not at all.

        Raises
        ------
        OSError
            If it cannot be written; nothing is left behind then.
        """

        def write(temporary: Path) -> None:
            temporary.write_text(self.text, "utf-8")

        write_atomically(Path(path), write)

    def _repr_html_(self) -> str:
        """The page itself, in a notebook."""
        frame = "width: 100%; height: 480px; border: 0"
        return f'<iframe style="{frame}" srcdoc="{html.escape(self.text)}"></iframe>'

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self.text) / 1e6:.1f} MB of HTML)"


def page_text(name: str, scripts: Sequence[str], title: str, data: str) -> str:
    """HTML of a page by its name, around its scripts, which share one scope, and its archive."""
    folder = files(__package__) / "page"
    script = "\n".join((folder / f"{script}.js").read_text() for script in scripts)
    style = (folder / "style.css").read_text()
    content = (folder / f"{name}.html").read_text()
    template = Template((folder / "page.html").read_text())
    return template.substitute(
        title=html.escape(title), style=style, name=name, content=content, script=script, data=data
    )
