"""Count the functions that are handed a scene on its way through a precomputation.

    python docs/follow_scene.py [FOLDER OF THE PACKAGE]

Starting from ``precompute``, each call is followed that has a scene among its arguments: ``scene``, ``self.scene``,
``problem.scene`` and the like. A record that holds the scene, such as a problem, is not counted: whoever gets one reads
what is needed from it. What is printed are the functions entered, module by module, and their number.
"""

from __future__ import annotations

import ast
import sys
from collections import deque
from pathlib import Path

Place = tuple[str, str]  # a module's dotted name, and a function's name in it, after that of its class


def main(root: Path) -> None:
    """Print what is entered."""
    modules = {_dotted(path, root): ast.parse(path.read_text()) for path in root.rglob("*.py")}
    functions = {place: node for name, tree in modules.items() for place, node in _functions(name, tree)}
    names = {name: _imported(tree, functions) for name, tree in modules.items()}
    start = (f"{root.name}.precompute", "precompute")
    entered: set[Place] = set()
    queue = deque([start])
    while queue:
        place = queue.popleft()
        if place in entered or place not in functions:
            continue
        entered.add(place)
        for call in ast.walk(functions[place]):
            if isinstance(call, ast.Call) and any(map(_is_scene, _arguments(call))):
                target = _target(call.func, place, names[place[0]], functions)
                if target is not None:
                    queue.append(target)
    for module, function in sorted(entered):
        print(f"{module.removeprefix(root.name + '.')}: {function}")
    print(f"{len(entered)} functions in {len({module for module, _ in entered})} modules")


def _dotted(path: Path, root: Path) -> str:
    parts = path.relative_to(root.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _functions(module: str, tree: ast.Module) -> list[tuple[Place, ast.AST]]:
    """Functions, and classes' methods; a class itself stands for its ``__init__``."""
    found: list[tuple[Place, ast.AST]] = []
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            found.append(((module, node.name), node))
        elif isinstance(node, ast.ClassDef):
            for method in node.body:
                if isinstance(method, ast.FunctionDef):
                    name = node.name if method.name == "__init__" else f"{node.name}.{method.name}"
                    found.append(((module, name), method))
    return found


def _imported(tree: ast.Module, functions: dict[Place, ast.AST]) -> dict[str, Place]:
    """What a name stands for in a module."""
    return {
        alias.asname or alias.name: (node.module, alias.name)
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
        if (node.module, alias.name) in functions
    }


def _arguments(call: ast.Call) -> list[ast.expr]:
    return [*call.args, *(keyword.value for keyword in call.keywords)]


def _is_scene(argument: ast.expr) -> bool:
    if isinstance(argument, ast.Starred):
        argument = argument.value
    name = argument.id if isinstance(argument, ast.Name) else getattr(argument, "attr", "")
    return name in ("scene", "_scene")


def _target(
    called: ast.expr, place: Place, names: dict[str, Place], functions: dict[Place, ast.AST]
) -> Place | None:
    """The function of the package that is called, None if it is none of it or cannot be told."""
    module, caller = place
    if isinstance(called, ast.Name):
        return names.get(called.id, (module, called.id))
    if isinstance(called, ast.Attribute) and isinstance(called.value, ast.Name):
        owner = called.value.id
        if owner in ("self", "cls"):
            return module, f"{caller.split('.')[0]}.{called.attr}"
        own = names.get(owner)
        return (own[0], f"{owner}.{called.attr}") if own else None
    return None


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "mi_sparse_prt").resolve())
