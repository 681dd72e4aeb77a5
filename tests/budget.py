"""Counts what grows, and fails where that exceeds the budget of pyproject.toml: part of lint.

Code lines are those of ``src/geogs`` that carry code: no blank line, comment, docstring or import.
Constants are numbers, or tuples of numbers, that a module of ``src/geogs`` assigns to an upper-case
name. Words are those of ``docs`` without its notebook, which may grow, and without the reference,
which docstrings make. Who raises a budget says why in the commit.
"""

import ast
import sys
import tokenize
import tomllib
from collections.abc import Iterable, Iterator
from io import StringIO
from pathlib import Path

ROOT = Path(__file__).parents[1]
WITHOUT_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}


def code_lines(text: str) -> int:
    """Lines of a module that carry code."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(StringIO(text).readline):
        if token.type not in WITHOUT_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    left_out = [n for node in ast.walk(ast.parse(text)) for n in _imports_and_docstrings(node)]
    for node in left_out:
        lines.difference_update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(lines)


def _imports_and_docstrings(node: ast.AST) -> Iterator[ast.stmt]:
    if isinstance(node, ast.Import | ast.ImportFrom):
        yield node
    body = getattr(node, "body", None)
    for statement in body if isinstance(body, list) else ():
        value = statement.value if isinstance(statement, ast.Expr) else None
        if isinstance(value, ast.Constant) and isinstance(value.value, str):
            yield statement


def constants(text: str) -> int:
    """Numbers, or tuples of numbers, that a module gives upper-case names, counted by statement."""
    return sum(map(_is_constant, ast.parse(text).body))


def _is_constant(statement: ast.stmt) -> bool:
    if isinstance(statement, ast.Assign):
        targets = statement.targets
    elif isinstance(statement, ast.AnnAssign):
        targets = [statement.target]
    else:
        return False
    names = (target.elts[0] if isinstance(target, ast.Tuple) else target for target in targets)
    is_named = any(isinstance(n, ast.Name) and n.id.strip("_").isupper() for n in names)
    return is_named and _is_number(statement.value)


def _is_number(value: ast.expr | None) -> bool:
    match value:
        case ast.UnaryOp():
            return _is_number(value.operand)
        case ast.BinOp():
            return _is_number(value.left) and _is_number(value.right)
        case ast.Tuple():
            return bool(value.elts) and all(map(_is_number, value.elts))
        case ast.Constant():
            return type(value.value) in (int, float)
    return False


def counted() -> dict[str, int]:
    """What the project has of everything that has a budget."""
    modules = _texts(ROOT.glob("src/geogs/**/*.py"))
    written = (p for p in ROOT.glob("docs/**/*.md") if "notebook" not in p.parts)
    pages = _texts(p for p in written if p.name != "reference.md")
    return {
        "code-lines": sum(map(code_lines, modules)),
        "constants": sum(map(constants, modules)),
        "words-of-documents": sum(len(page.split()) for page in pages),
    }


def _texts(paths: Iterable[Path]) -> list[str]:
    return [path.read_text(encoding="utf-8") for path in sorted(paths)]


def main() -> None:
    """Print what there is of each, and exit with 1 where that is more than the budget."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    budget = project["tool"]["geogs"]["budget"]
    found = counted()
    for name, count in found.items():
        print(f"{name}: {count} of {budget[name]}")
    exceeded = [name for name, count in found.items() if count > budget[name]]
    if exceeded:
        sys.exit(f"Over budget (pyproject.toml, tool.geogs.budget): {', '.join(exceeded)}.")


if __name__ == "__main__":
    main()
