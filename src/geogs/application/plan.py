"""The stages of a command before it runs, and their time by earlier results."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from geogs.application.results.output_folder import read_summary
from geogs.application.run_settings import RunSettings
from geogs.errors import InputError
from geogs.evaluation.duration import duration
from geogs.geometry.camera import Camera
from geogs.guard.documents import UNUSABLE
from geogs.io.sources.frame_source import Source
from geogs.io.writers.intrinsics_file import read_camera

POSED_STAGES = ("reading", "depth", "training", "mesh", "report")
"""Stages of a reconstruction from known poses."""
_GROWTH = (0.5, 1.2)
"""Least and largest power of the number of pixels by which the time of a command grows: a part of
it is the same for any video."""
_SPREAD = 1.3
"""How much longer or shorter the same command may take."""


@dataclass(frozen=True)
class Earlier:
    """Time and memory of an earlier result."""

    pixels: float
    """Pixels of all of its frames."""
    seconds: float
    memory: float
    """Bytes."""


def run_stages(settings: RunSettings, source: Source, maps_at_end: bool) -> tuple[str, ...]:
    """Names of the stages of a run, in order; none where they follow from what is found.

    ``maps_at_end``: whether the map is made once, after the video.
    """
    if settings.sfm:
        return ()
    is_open = settings.config.calibration.refine and source.is_calibration_open
    first = ("calibration",) if is_open or source.is_shutter_open else ()
    mapping = "mapping" if maps_at_end else "map refinement"
    return (*first, "frames", "bundle adjustment", mapping, "mesh", "report")


@dataclass(frozen=True)
class Plan:
    """Folder, stages, time and memory of a command."""

    output: Path
    """Folder of the result."""
    device: str
    """cpu or cuda."""
    stages: tuple[str, ...]
    seconds: tuple[float, float] | None
    """Range of the time; none where nothing tells it."""
    memory: float | None
    """Bytes; none where nothing tells it."""
    basis: str
    """By what time and memory are known, or why they are not."""

    def lines(self) -> list[str]:
        """The plan as the terminal shows it."""
        where = f"{os.cpu_count()} CPU cores" if self.device == "cpu" else "a GPU"
        lines = [f"Result: {self.output}, made on {where}."]
        lines += [f"Stages: {', '.join(self.stages)}."] if self.stages else []
        if self.seconds is None or self.memory is None:
            return [*lines, f"Time and memory: unknown, as {self.basis}."]
        low, high = map(duration, self.seconds)
        return [
            *lines,
            f"Time: {low} to {high}, by {self.basis}.",
            f"Memory: about {self.memory / 2**30:.1f} GB, as the largest of these took.",
        ]


def plan_for(
    stages: tuple[str, ...], output: Path, frames: int | None, camera: Camera, device: str
) -> Plan:
    """The plan of a command; its time and memory by the results beside its own.

    Args:
        stages: names of the stages.
        output: folder of the result.
        frames: number of frames; none where it is not known beforehand.
        camera: camera of the working images.
        device: cpu or cuda.
    """
    if frames is None:
        why = "the number of frames is not known beforehand"
        return Plan(output, device, stages, None, None, why)
    known = list(earlier_results(output.parent, device))
    if not known:
        why = f"{output.parent}/ holds no earlier result of this kind of device"
        return Plan(output, device, stages, None, None, why)
    seconds = expected_seconds(known, float(frames * camera.width * camera.height))
    memory = max(result.memory for result in known)
    count = "1 earlier result" if len(known) == 1 else f"{len(known)} earlier results"
    return Plan(output, device, stages, seconds, memory, f"{count} in {output.parent}/")


def expected_seconds(known: Sequence[Earlier], pixels: float) -> tuple[float, float]:
    """Range of the time for so many pixels, by earlier results."""
    times = [
        result.seconds * (pixels / result.pixels) ** power for result in known for power in _GROWTH
    ]
    return min(times) / _SPREAD, max(times) * _SPREAD


def earlier_results(folder: Path, device: str) -> Iterator[Earlier]:
    """Complete results in the folders of a folder, made on a CPU or on a GPU as ``device`` is."""
    for path in sorted(folder.glob("*/summary.json")):
        try:
            summary = read_summary(path.parent)
            camera = read_camera(path.parent / "intrinsics.json")
            if summary["interrupted"] or (summary["device"] == "cpu") != (device == "cpu"):
                continue
            pixels = float(summary["frames"]) * camera.width * camera.height
            total = float(summary["seconds"]["total"])
            found = Earlier(pixels, total, float(summary["peak_memory_bytes"]))
        except (InputError, *UNUSABLE):
            continue
        if min(found.pixels, found.seconds) > 0:
            yield found
