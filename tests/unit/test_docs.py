"""README and pages: what they show exists. Sphinx itself (`bash .ci/docs`) checks their links and docstrings."""

import ast
import importlib
import inspect
import re
import shlex
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mitsuba as mi
import pytest
import typer

import mi_sparse_prt as prt
from mi_sparse_prt.cli import app
from mi_sparse_prt.plugins import classes

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").rglob("*.md"))]
FENCED = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(language: str) -> list:
    """Code of a language on all pages, each named by its page and number."""
    return [
        pytest.param(code, id=f"{page.relative_to(ROOT)}-{number}")
        for page in PAGES
        for number, (found, code) in enumerate(FENCED.findall(page.read_text()))
        if found == language
    ]


def test_the_readme_is_short():
    assert len(README.read_text().splitlines()) <= 150


def test_files_that_the_readme_links_to_exist():
    targets = re.findall(r"\]\(([^)#]+)", README.read_text())
    missing = [t for t in targets if not t.startswith("http") and not (ROOT / t).exists()]
    assert targets
    assert not missing


def test_every_public_name_is_in_the_reference():
    listed = re.findall(r"^\.\. auto\w+:: (\w+)", (ROOT / "docs/reference/api.rst").read_text(), re.MULTILINE)
    assert sorted(listed) == sorted(prt.__all__)


def test_every_plugin_is_in_the_reference():
    listed = re.findall(
        r"^\.\. plugin-manual:: (\w+)", (ROOT / "docs/reference/plugins.rst").read_text(), re.MULTILINE
    )
    assert sorted(listed) == sorted(classes.__all__)


@pytest.mark.parametrize("code", blocks("python"))
def test_python_calls_what_exists_with_arguments_that_exist(code):
    """Expected: imports can be imported; functions and classes at the top of the package take what they are given."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom):
            module = importlib.import_module(node.module)
            assert all(hasattr(module, alias.name) for alias in node.names)
        elif public_name(node):
            assert public_name(node) in prt.__all__
        elif isinstance(node, ast.Call) and (name := public_name(node.func)):
            keywords = {k.arg: k.value for k in node.keywords}
            inspect.signature(getattr(prt, name)).bind(*node.args, **keywords)


def public_name(node: ast.AST) -> str | None:
    """X of ``prt.X``."""
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "prt":
        return node.attr
    return None


@pytest.mark.parametrize("code", blocks("xml"))
def test_xml_is_accepted_by_mitsuba(code, tmp_path, monkeypatch):
    """Expected: Mitsuba knows the plugins and asks for every parameter that is given."""
    ElementTree.fromstring(code)
    (tmp_path / "scenes_xml").symlink_to(ROOT / "scenes_xml")
    monkeypatch.chdir(tmp_path)
    whole = code if code.startswith("<scene") else f'<scene version="3.0.0">{code}</scene>'
    (tmp_path / "scene.xml").write_text(whole)
    mi.load_file(str(tmp_path / "scene.xml"))


@pytest.mark.parametrize("code", blocks("sh"))
def test_commands_and_their_options_exist(code):
    commands = typer.main.get_command(app).commands
    for line in code.splitlines():
        words = shlex.split(line, comments=True)
        if words[:1] == ["mi-sparse-prt"]:
            known = {name for parameter in commands[words[1]].params for name in parameter.opts}
            assert {word for word in words[2:] if word.startswith("-")} <= known
        elif words[:1] == ["bash"]:
            assert (ROOT / words[1]).exists()
