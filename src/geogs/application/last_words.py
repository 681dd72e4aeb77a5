"""What a command says at its end: how good, how much, how long, and what lies where."""

from geogs.application.results.result import Written
from geogs.evaluation.duration import duration
from geogs.io.sources.posed.base import PosedSource

NOT_JUDGED = (
    "How far this is to be relied on was not worked out: the adjustment of all keyframes is "
    "missing."
)
"""Said of a run that was stopped."""


def last_words(written: Written, seconds: float) -> list[str]:
    """Lines for the user after a run or a reconstruction, which took so many seconds."""
    result, output = written.result, written.output
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
