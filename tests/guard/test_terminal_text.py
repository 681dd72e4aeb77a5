"""No name of a file reaches the terminal as more than text."""

import ast
import io
import logging
from pathlib import Path

import pytest

from geogs.application.progress.terminal_progress import TerminalProgress
from geogs.application.run_settings import Verbosity
from geogs.cli.main import print_error
from geogs.cli.terminal import process
from geogs.guard.terminal_text import escape_records, printable, say

SOURCES = Path(__file__).parents[2] / "src"
HOSTILE = {
    "escape": "a\x1b]0;owned\x07b",
    "bell": "a\x07b",
    "newline": "a\nerror: all is lost",
    "return": "a\rb",
    "backspace": "aaa\b\b\bb",
    "bidi": "a\u202egnp.exe",
    "c1": "a\x9b31mb",
    "separator": "a\u2028b",
    "bytes": "a\udcffb",
}


@pytest.mark.parametrize("name", HOSTILE.values(), ids=HOSTILE)
def test_every_way_to_the_terminal_and_to_the_log_escapes(name, tmp_path, capsys):
    log = tmp_path / "log.txt"
    say(f"Results are in {name}/: mesh.ply", f"Open {name}")
    say(name, is_error=True)
    print_error(f"{name} does not exist.")
    with TerminalProgress(Verbosity(log=log)) as progress:
        progress.write(f"note: {name}")
        progress.stage(name, 0.5)
    before = logging.getLogger("geogs").handlers[:]
    process.show_warnings()
    try:
        logging.getLogger("geogs").warning("%s cannot be read; skipped.", name)
    finally:
        logging.getLogger("geogs").handlers[:] = before
    shown = capsys.readouterr()
    lines = [*shown.out.split("\n"), *shown.err.split("\n"), *log.read_text().split("\n")]
    assert len([line for line in lines if printable(name) in line]) >= 6
    assert all(line.isprintable() for line in lines), lines


def test_printable_text_stays_as_it_is():
    text = "Zürich, 東京, façade №3, κ = 2²: [bold]100 %[/]"
    assert printable(text) == text
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    escape_records(handler)
    handler.setFormatter(logging.Formatter("warning: %(message)s"))
    handler.handle(logging.makeLogRecord({"msg": text}))
    assert stream.getvalue() == f"warning: {text}\n"


def _names(call):
    """The name of a called function, and of the function called in its first argument."""
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    first = call.args[0] if call.args else None
    inner = getattr(getattr(first, "func", None), "id", "")
    return name, "constant" if isinstance(first, ast.Constant) else inner


def test_nothing_prints_foreign_text_another_way():
    """``say`` and ``escape_records`` print; others only constants, and tables without markup."""
    found = []
    for path in sorted(SOURCES.rglob("*.py")):
        tree = ast.parse(path.read_text())
        escapes = "escape_records(" in path.read_text()
        for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
            name, first = _names(call)
            is_print = name == "print" and first not in ("constant", "printable")
            text = ast.unparse(call)
            is_stream = "sys.stdout.write" in text or "sys.stderr.write" in text
            is_handler = name in ("StreamHandler", "FileHandler") and not escapes
            if is_print or is_stream or is_handler or text.startswith("warnings.warn("):
                found.append(f"{path.relative_to(SOURCES)}: {text}")
    assert sorted(found) == [
        "geogs/cli/eval.py: Console(markup=False).print(table(evaluation))",
        "geogs/cli/main.py: print(f'\\x1b[31m{text}\\x1b[0m' if is_coloured else text, "
        "file=sys.stderr)",
        "geogs/guard/terminal_text.py: print('\\n'.join(map(printable, lines)), "
        "file=file, flush=True)",
        "geogs_bench/board/commands.py: print(json.dumps(asdict(measured(sys.argv[1:]))))",
        "geogs_bench/cli.py: Console(markup=False).print(table)",
    ]
