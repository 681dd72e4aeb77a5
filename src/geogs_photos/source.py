"""Photographs without poses: these are estimated once, stored with the result, and reused."""

import json
from dataclasses import asdict, replace
from pathlib import Path

from geogs.application.interrupt import Stop
from geogs.application.progress.run_progress import RunProgress
from geogs.config import ReconstructConfig
from geogs.documents import UNUSABLE, expanded, read_json
from geogs.errors import InputError
from geogs.io.sources.formats.colmap import open_colmap
from geogs.io.sources.posed.one_camera import OneCamera
from geogs.io.sources.posed.posed_source import PosedSource
from geogs.io.writers.atomic import write_text
from geogs.io.writers.replacement import replaced
from geogs_photos.effort import features_for, what_does_not_fit
from geogs_photos.photograph import PhotoFolder, find_photographs
from geogs_photos.poses import FoundPoses, find_poses

NAMED = 8
"""Most photographs left out that are named on the terminal."""


def open_photographs(
    folder: Path,
    config: ReconstructConfig,
    kept: Path,
    hold_out: int | None = None,
    again: bool = False,
    progress: RunProgress | None = None,
    stop: Stop | None = None,
    seconds: float | None = None,
) -> PosedSource:
    """Open photographs as a source; their poses are estimated from them, or were so before.

    For the arguments and errors see
    ``geogs.application.structure_from_motion.photos.open_photographs``.
    """
    progress, stop = progress or RunProgress(), stop or Stop()
    chosen, selection = find_photographs(folder), config.input
    some = chosen.photographs[selection.start : selection.stop : selection.stride]
    chosen = replace(chosen, photographs=some)
    note = kept / "photographs.json"
    model = kept / "sparse" / "0"
    if again and note.is_file():
        found = _read(note)
    else:

        def report(stage: str, fraction: float) -> None:
            progress.stage(stage, fraction)
            stop.check()

        count = len(some)
        progress.write(what_does_not_fit(count, seconds))
        most = features_for(count, seconds)
        with replaced(kept, "beside") as new:
            model_new = new / model.relative_to(kept)
            found = find_poses(chosen, model_new, selection.intrinsics, config.seed, report, most)
            write_text(new / note.name, json.dumps(asdict(found), indent=2))
    source = _source(folder, chosen, model, found, config, hold_out)
    count = len(chosen.photographs) + len(chosen.damaged)
    _tell(found, source.left_out, count, progress)
    return source


def _source(
    folder: Path,
    chosen: PhotoFolder,
    model: Path,
    found: FoundPoses,
    config: ReconstructConfig,
    hold_out: int | None,
) -> PosedSource:
    """The photographs with a pose, except those of very different cameras."""
    posed = open_colmap(model, chosen.root)
    auto = replace(config.input, intrinsics="auto", start=0, stop=None, stride=1)
    unlike = OneCamera(posed.files, auto).unlike()
    names = [file.path.relative_to(chosen.root).as_posix() for file in posed.files]
    others = [(names[i], "was taken with quite another camera than most") for i in unlike]
    posed = posed.only([i for i in range(len(names)) if i not in set(unlike)])
    name = expanded(folder).resolve().name
    posed = replace(posed, kind="photographs", name=name, left_out=(*found.left_out, *others))
    return PosedSource(posed, auto, hold_out)


def _tell(
    found: FoundPoses,
    left_out: tuple[tuple[str, str], ...],
    count: int,
    progress: RunProgress,
) -> None:
    progress.write(
        f"{count - len(left_out)} of {count} photographs have a pose; points are "
        f"{found.error:.2f} pixels from where they were seen."
    )
    for name, reason in left_out[:NAMED]:
        progress.write(f"left out: {name} {reason}.")
    if len(left_out) > NAMED:
        progress.write(f"left out: {len(left_out) - NAMED} more; summary.json says which and why.")


def _read(note: Path) -> FoundPoses:
    """The outcome of an earlier call. Raises InputError if it cannot be read."""
    try:
        values = read_json(note)
        left_out = tuple((str(name), str(why)) for name, why in values["left_out"])
        return FoundPoses(left_out, float(values["error"]))
    except UNUSABLE as error:
        raise InputError(f"{note} is damaged; leave out --resume.") from error
