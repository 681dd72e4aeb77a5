"""Writes docs/reference.md: ``python tests/reference_page.py > docs/reference.md``.

Made from the sources, not from what is imported: signatures look different in each Python.
"""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

SOURCES = Path(__file__).parents[1] / "src"

_INTRODUCTION = """\
# Reference

Made from the docstrings by `python tests/reference_page.py`; a test holds this page to them.
[From Python](api.md) has examples, and `help(geogs.track)` describes one function in full.
"""

PARTS = {
    "Whole runs": {
        "geogs.run": "application/run_in_python.py",
        "geogs.reconstruct": "application/reconstruct.py",
        "geogs.load_result": "application/results/saved_result.py",
        "SavedResult": (
            "application/results/saved_result.py",
            "trajectory verdict summary mesh keyframes disks camera render",
        ),
        "SavedKeyframe": ("application/results/saved_result.py", "T_cw depth normal weight image"),
    },
    "Frame by frame": {
        "geogs.open_source": "io/sources/sniff.py",
        "geogs.track": "application/slam_in_python.py",
        "geogs.Slam": ("slam.py", "__init__ process finish"),
        "geogs.Slam, read": ("slam_output.py", "trajectory uncertainty snapshot render statistics"),
        "geogs.PoseEstimate": (
            "pose_estimate.py",
            "T_cw T_wc is_tracked sigma_position sigma_rotation",
        ),
        "geogs.Frame": ("types.py", "index timestamp image depth pose mask"),
        "geogs.Camera": ("geometry/camera.py", "K resized with_field_of_view"),
        "geogs.slam_mesh": "application/slam_in_python.py",
        "geogs.save_slam": "application/slam_in_python.py",
        "geogs.load_slam": "application/slam_in_python.py",
    },
    "Disks": {
        "geogs.load_map": "io/writers/map_file.py",
        "geogs.render": "splat/render.py",
        "geogs.render_vjp": "splat/render.py",
    },
    "Settings": {"geogs.config.preset": "config/run_config.py"},
}
"""What has an entry: a function, or a class with some of its members."""


def document() -> str:
    """The page."""
    parts = [_INTRODUCTION]
    for heading, entries in PARTS.items():
        parts.append(f"## {heading}\n")
        for name, where in entries.items():
            path, members = (where, "") if isinstance(where, str) else where
            tree = ast.parse((SOURCES / "geogs" / path).read_text())
            own = "SlamOutput" if name == "geogs.Slam, read" else name.rpartition(".")[2]
            parts += _entry(name, _named(tree, own), members.split())
    return "\n".join(parts)


def _entry(name: str, node: ast.stmt, members: list[str]) -> Iterator[str]:
    if isinstance(node, ast.FunctionDef):
        yield f"### {name}\n\n`{name}{_signature(node)}`\n\n{_text(ast.get_docstring(node))}"
        return
    assert isinstance(node, ast.ClassDef)
    yield f"### {name}\n\n{_text(ast.get_docstring(node))}"
    for member in members:
        found = _named(node, member)
        said = _text(_documented(node, found))
        yield f"**`{_shown(name, found)}`** {said}".rstrip(" ")


def _shown(owner: str, node: ast.stmt) -> str:
    if isinstance(node, ast.FunctionDef):
        if any(getattr(d, "id", "").endswith("property") for d in node.decorator_list):
            return f".{node.name} -> {ast.unparse(node.returns)}"
        name = owner if node.name == "__init__" else f".{node.name}"
        return f"{name}{_signature(node)}"
    assert isinstance(node, ast.AnnAssign)
    return f".{ast.unparse(node.target)}: {ast.unparse(node.annotation)}"


def _signature(node: ast.FunctionDef) -> str:
    arguments = ast.unparse(node.args).removeprefix("self, ").removeprefix("self")
    returns = ast.unparse(node.returns) if node.returns else "None"
    return f"({arguments})" if returns == "None" else f"({arguments}) -> {returns}"


def _named(owner: ast.Module | ast.ClassDef, name: str) -> ast.stmt:
    for node in owner.body:
        target = getattr(node, "target", None)
        if name in (getattr(node, "name", None), getattr(target, "id", None)):
            return node
    raise LookupError(f"{name} is nowhere")


def _documented(owner: ast.ClassDef, node: ast.stmt) -> str:
    """The docstring of a method, or the string under a field."""
    if isinstance(node, ast.FunctionDef):
        return ast.get_docstring(node) or ""
    after = owner.body[owner.body.index(node) + 1 :][:1]
    value = after[0].value if after and isinstance(after[0], ast.Expr) else None
    return str(value.value) if isinstance(value, ast.Constant) else ""


def _text(docstring: str | None) -> str:
    """The first paragraph of a docstring, and its lists of arguments and errors, as Markdown."""
    first, *others = (docstring or "").split("\n\n")
    kept = [first, *(part for part in others if re.match(r"(Args|Raises|Returns):?", part))]
    lines = []
    in_list = False
    for line in "\n\n".join(kept).splitlines():
        if re.fullmatch(r"(Args|Raises|Returns):", line):
            in_list = line != "Returns:"
            lines.append(f"{line}\n")
        elif in_list and re.match(r"    \w[\w, ]*:", line):
            name, _, rest = line.strip().partition(":")
            lines.append(f"- `{name}`:{rest}")
        else:
            in_list = in_list and (not line or line.startswith(" "))
            lines.append(f"  {line.strip()}" if in_list and line else line.strip())
    text = "\n".join(lines)
    text = re.sub(r":(?:func|class|meth):`~?\.?([^`]+)`", r"`\1`", text)
    return text.replace("``", "`").replace("::\n", ":\n") + "\n"


if __name__ == "__main__":
    sys.stdout.write(document())
