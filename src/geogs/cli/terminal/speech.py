"""Messages of a command during its work and at its end."""

import logging
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import TYPE_CHECKING

from geogs.application.run_settings import RunSettings, Verbosity
from geogs.cli.answer import EXIT_NOT_RELIABLE, Answer
from geogs.errors import TrackingLost
from geogs.guard.terminal_text import printable, say

if TYPE_CHECKING:
    from geogs.application.interrupt import Stop
    from geogs.application.plan import Plan
    from geogs.application.progress.run_progress import RunProgress
    from geogs.application.results.result import Result
    from geogs.io.sources.frame_source import Source
    from geogs.io.sources.posed.posed_source import PosedSource


FILES = ("trajectory.tum", "mesh.ply", "splats.ply", "map.safetensors", "summary.json")
"""Files of a result that its closing message names."""
NOT_JUDGED = "Reliability unknown: the run was interrupted before the final adjustment."
"""Message for an interrupted run."""


def say_loading(options: Verbosity) -> None:
    """Show a loading message on a terminal; the first progress report overwrites it."""
    if not options.quiet and sys.stderr is not None and sys.stderr.isatty():
        print("loading ...", end="\r", file=sys.stderr, flush=True)


def dry_answer(source: "Source | PosedSource", plan: "Plan") -> Answer:
    """Answer to ``--dry-run``: the account of the input, and the plan."""
    lines = [*source.account.lines(source.found), *plan.lines()]
    found = {"found": source.found, **asdict(source.account)}
    return Answer("\n".join(map(printable, lines)), {"input": found, "plan": asdict(plan)})


def followed(
    options: Verbosity,
    work: Callable[["RunProgress"], "Result"],
    stop: "Stop",
    way_on: str,
    strict: bool = False,
) -> Answer:
    """Do the work of a command, with a line of progress on the standard error.

    Args:
        options: how much is said.
        work: makes and writes the result.
        stop: the request to stop that the work heeds.
        way_on: the command that goes on with an interrupted result, as ``{folder}``'s.
        strict: whether the exit code tells that the result is not reliable.

    Raises:
        TrackingLost: uninterrupted work ended without a mesh; the other files are kept.
    """
    from geogs.application.progress.terminal_progress import TerminalProgress

    begin = time.perf_counter()
    if options.verbose:
        logging.getLogger("geogs").setLevel(logging.INFO)
        for handler in logging.getLogger("geogs").handlers:
            handler.setLevel(logging.INFO)
            handler.setFormatter(logging.Formatter("%(message)s"))
    with TerminalProgress(options) as progress:
        result = work(progress)
        progress.end_phase()
        words = closing_message(result, time.perf_counter() - begin)
        if isinstance(options, RunSettings) and not result.is_interrupted:
            from geogs.application.remedy import remedy

            took = result.scene.stopwatch.total
            said = remedy(options, result.source, result.verdict, took)
            words += [f"Suggestion: {said}"] if said else []
        words += [way_on.format(folder=printable(result.folder))] if result.can_resume else []
        for line in words:
            progress.note(line)
    judged = result.verdict
    is_doubtful = judged is not None and not judged.is_reliable
    if judged is not None and is_doubtful and options.quiet:
        say(f"warning: {judged.sentence}", is_error=True)
    if result.mesh is None and not result.is_interrupted:
        if not options.quiet:
            say(*words)
        why = result.why_no_map or "The surface could not be determined."
        raise TrackingLost(f"No mesh was made; the other files are in {result.folder}/. {why}")
    code = EXIT_NOT_RELIABLE if is_doubtful and strict else 0
    code = stop.code if result.is_interrupted else code
    values = {**result_values(result), "warnings": progress.warnings}
    return Answer("" if options.quiet else "\n".join(words), values, code)


def result_values(result: "Result") -> dict[str, object]:
    """A result for a program: its folder, its files, and its summary with the verdict."""
    from geogs.application.results.output_folder import read_summary

    folder = result.folder
    assert folder is not None, "it has been written"
    files = {name: folder / name for name in (*FILES, "report/index.html")}
    there = {name: path for name, path in files.items() if path.is_file()}
    return {"folder": folder, "files": there, **read_summary(folder)}


def closing_message(result: "Result", seconds: float) -> list[str]:
    """Closing lines after a run or a reconstruction, which took ``seconds``."""
    from geogs.evaluation.duration import duration
    from geogs.io.sources.posed.posed_source import PosedSource

    output = result.folder
    assert output is not None, "it has been written"
    lines = []
    if result.verdict is not None:
        lines.append(result.verdict.sentence)
    elif not isinstance(result.source, PosedSource):
        lines.append(NOT_JUDGED)
    mesh = result.mesh
    parts = [f"{len(result.keyframes.timestamps)} keyframes", f"{len(result.map)} disks"]
    parts += [] if mesh is None else [f"{len(mesh.faces)} triangles"]
    lines.append(f"{result.scene.frames} frames in {duration(seconds)}: {', '.join(parts)}.")
    there = [name for name in FILES if (output / name).is_file()]
    lines.append(f"Results are in {output}/: {', '.join(there)}")
    page = output / "report" / "index.html"
    if page.is_file():
        lines.append(f"Open {page} in a browser.")
    return lines
