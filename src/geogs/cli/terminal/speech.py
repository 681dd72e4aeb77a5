"""What a command says while it works and at its end."""

import logging
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from geogs.application.run_settings import RunSettings, Verbosity
from geogs.errors import TrackingLost

if TYPE_CHECKING:
    from geogs.application.progress.run_progress import RunProgress
    from geogs.application.results.result import Result


NOT_JUDGED = "Reliability unknown: the run was interrupted before the final adjustment."
"""Said of a run that was stopped."""


def say_loading(options: Verbosity) -> None:
    """A word on a terminal before what takes seconds to load; the first news writes over it."""
    if not options.quiet and sys.stderr is not None and sys.stderr.isatty():
        print("loading ...", end="\r", file=sys.stderr, flush=True)


def followed(options: Verbosity, work: Callable[["RunProgress"], "Result"]) -> "Result":
    """Do the work of a command, with a line of progress on the standard error, and say at its end
    on the standard output what came of it.

    Raises:
        TrackingLost: there is no mesh in the end, of a work that nobody stopped; the rest is kept.
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
        words += _remedy(options, result)
        progress.note("\n".join(words))
    if not options.quiet:
        print("\n".join(words))
    if result.mesh is None and not result.is_interrupted:
        why = result.why_no_map or "Of what was seen no surface is known."
        raise TrackingLost(f"There is no mesh; the rest is in {result.folder}/. {why}")
    return result


def _remedy(options: Verbosity, result: "Result") -> list[str]:
    """The command that may help where a run came to its end and is not reliable."""
    from geogs.application.remedy import remedy

    if not isinstance(options, RunSettings) or result.is_interrupted:
        return []
    said = remedy(options, result.source, result.verdict, result.scene.stopwatch.total)
    return [f"What may help: {said}"] if said else []


def closing_message(result: "Result", seconds: float) -> list[str]:
    """Lines for the user after a run or a reconstruction, which took so many seconds."""
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
    there = ["trajectory.tum", "mesh.ply", "splats.ply", "map.safetensors", "summary.json"]
    there = [name for name in there if (output / name).is_file()]
    lines.append(f"Results are in {output}/: {', '.join(there)}")
    page = output / "report" / "index.html"
    if page.is_file():
        lines.append(f"Open {page} in a browser.")
    return lines
