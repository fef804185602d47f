"""How large the package is: lines of code, long functions, functions with many parameters.

Lines are those that hold code: blank lines, comments and docstrings aside. Compiled kernels (``numba.njit``) may have
as many parameters as they need, and ``self`` is none.

    python docs/code_size.py [FOLDER]
"""

from __future__ import annotations

import ast
import io
import sys
import tokenize
from pathlib import Path

LONG, MANY = 60, 7
NO_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}

Function = ast.FunctionDef | ast.AsyncFunctionDef


def code_lines(source: str) -> set[int]:
    """Numbers of the lines of a module that hold code."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in NO_CODE:
            lines |= set(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | Function) and ast.get_docstring(node) is not None:
            lines -= set(range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1))
    return lines


def is_kernel(function: Function) -> bool:
    """Whether numba compiles it."""
    return any("njit" in ast.unparse(decorator) for decorator in function.decorator_list)


def parameters(function: Function) -> int:
    """Of a call, without ``self``."""
    given = function.args
    names = [argument.arg for argument in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    return len([name for name in names if name not in ("self", "cls")])


def main() -> None:
    """Print the figures of a folder."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[1] / "mi_sparse_prt"
    total, long, many = 0, [], []
    files = sorted(folder.rglob("*.py"))
    for path in files:
        source = path.read_text()
        code = code_lines(source)
        total += len(code)
        for node in ast.walk(ast.parse(source)):
            if not isinstance(node, Function):
                continue
            where = f"{path.relative_to(folder)}:{node.name}"
            size = len(code & set(range(node.lineno, (node.end_lineno or 0) + 1)))
            if size > LONG:
                long.append(f"{where} {size}")
            if parameters(node) > MANY and not is_kernel(node):
                many.append(f"{where} {parameters(node)}")
    print(f"{len(files)} files, {total} lines of code")
    print(f"{len(long)} functions of more than {LONG} lines", *long, sep="\n  ")
    print(f"{len(many)} functions of more than {MANY} parameters", *many, sep="\n  ")


if __name__ == "__main__":
    main()
