"""Directives that read a page's text from the package and its notebooks, so that it cannot be older than these."""

from __future__ import annotations

import enum
import inspect
import json
from pathlib import Path
from typing import Any

import typer
from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.nodes import nested_parse_with_titles

import mi_sparse_prt  # noqa: F401 - it prepares Mitsuba for the plugins
from mi_sparse_prt.cli import app as command_line
from mi_sparse_prt.plugins import classes as plugin_classes

NOTEBOOKS = Path(__file__).parents[2] / "notebooks"


class PluginManual(Directive):
    """``.. plugin-manual:: Class``: the docstring of a plugin without its title."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        name = self.arguments[0]
        lines = (inspect.getdoc(getattr(plugin_classes, name)) or "").splitlines()
        if len(lines) > 1 and lines[1] and set(lines[1]) == {"-"}:
            lines = lines[2:]
        section = nodes.section()
        section.document = self.state.document
        nested_parse_with_titles(self.state, StringList(lines, source=f"docstring of {name}"), section)
        return section.children


class NotebookPicture(Directive):
    """``.. notebook-picture:: name number``: one of the pictures that a notebook stores."""

    required_arguments = 2

    def run(self) -> list[nodes.Node]:
        name, number = self.arguments
        notebook = json.loads((NOTEBOOKS / f"{name}.ipynb").read_text())
        outputs = [output for cell in notebook["cells"] for output in cell.get("outputs", [])]
        pictures = [o["data"]["image/png"] for o in outputs if "image/png" in o.get("data", {})]
        return [nodes.image(uri=f"data:image/png;base64,{pictures[int(number)].strip()}", alt=name)]


class Commands(Directive):
    """``.. commands::``: a section for each command of ``mi-sparse-prt``, with what its ``--help`` says."""

    def run(self) -> list[nodes.Node]:
        group: Any = typer.main.get_command(command_line)
        return [command_section(name, command) for name, command in group.commands.items()]


def command_section(name: str, command: Any) -> nodes.section:
    """What a command does, how it is called, its arguments and options."""
    section = nodes.section(ids=[nodes.make_id(name)], names=[name])
    section += nodes.title("", "", nodes.literal(text=name))
    arguments = [p.metavar for p in command.params if not p.opts[0].startswith("-")]
    usage = " ".join(["mi-sparse-prt", name, *arguments, "[OPTIONS]"])
    for number, paragraph in enumerate(command.help.split("\n\n")):
        if paragraph.startswith("Example: "):
            paragraph, usage = "", f"{usage}\n{paragraph.removeprefix('Example: ')}"
        if paragraph:
            section += nodes.paragraph(text=" ".join(paragraph.split("\n")))
        if number == 0:
            place = len(section)
    section.insert(place, nodes.literal_block(usage, usage, language="sh"))
    listed = nodes.definition_list()
    for parameter in command.params:
        if not parameter.hidden and parameter.name != "help":
            listed += parameter_item(parameter)
    section += listed
    return section


def parameter_item(parameter: Any) -> nodes.definition_list_item:
    """Names of a parameter, its meaning and its default."""
    choices = getattr(parameter.type_descriptor, "annotation", None)
    placeholder = parameter.metavar or ""
    if isinstance(choices, type) and issubclass(choices, enum.Enum):
        placeholder = " | ".join(str(choice.value) for choice in choices)
    is_option = parameter.opts[0].startswith("-")
    names = f"{', '.join(parameter.opts)} {placeholder}" if is_option else parameter.metavar
    default = parameter.show_default if isinstance(parameter.show_default, str) else parameter.default
    default = getattr(default, "value", default)
    meaning = parameter.help
    if parameter.required:
        meaning += " Required." if is_option else ""
    elif parameter.show_default and default not in (None, False, (), []):
        meaning += f" Default: {default}."
    return nodes.definition_list_item(
        "",
        nodes.term("", "", nodes.literal(text=names.strip())),
        nodes.definition("", nodes.paragraph(text=meaning)),
    )


def setup(app: Sphinx) -> dict[str, object]:
    """Sphinx calls this."""
    app.add_directive("plugin-manual", PluginManual)
    app.add_directive("commands", Commands)
    app.add_directive("notebook-picture", NotebookPicture)
    return {"parallel_read_safe": True}
