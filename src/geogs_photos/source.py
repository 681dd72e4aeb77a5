"""Photographs without poses: these are estimated once, stored with the result, and reused."""

import json
import math
from dataclasses import asdict, replace
from pathlib import Path

from geogs.application.interrupt import Stop
from geogs.application.progress.run_progress import RunProgress
from geogs.config import ReconstructConfig
from geogs.errors import InputError
from geogs.evaluation.duration import duration
from geogs.guard.atomic import write_text
from geogs.guard.documents import UNUSABLE, expanded, read_json
from geogs.guard.replacement import replaced
from geogs.io.sources.formats.colmap import open_colmap
from geogs.io.sources.posed.one_camera import OneCamera
from geogs.io.sources.posed.posed_source import PosedSource
from geogs.io.sources.selection import selection_of
from geogs.threads import worker_count
from geogs_photos.photo_features import MAX_FEATURES
from geogs_photos.photograph import PhotoFolder, find_photographs
from geogs_photos.poses import FoundPoses, find_poses

NAMED = 8
"""Most photographs left out that are named on the terminal."""
FEATURES = (MAX_FEATURES, 2896, 2048, 1448, 1024)
"""Limits on the features of a photograph if time is limited: each halves the time of matching."""
LEAST_MAP = 20.0
"""Seconds of the smallest map, with loading, mesh and files."""


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
    progress = progress or RunProgress()
    stop = stop or Stop()
    chosen = find_photographs(folder)
    selection = selection_of(config.input, None)
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
            found = find_poses(
                chosen, model_new, config.input.intrinsics, config.seed, report, most
            )
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
    posed = posed.only([i for i in range(len(names)) if i not in unlike])
    name = expanded(folder).resolve().name
    posed = replace(
        posed,
        kind="photographs",
        name=name,
        left_out=(*found.left_out, *others),
        account=posed.account + chosen.account,
    )
    return PosedSource(posed, auto, hold_out)


def _tell(
    found: FoundPoses, left_out: tuple[tuple[str, str], ...], count: int, progress: RunProgress
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


def seconds_to_find_poses(count: int, features: int) -> float:
    """Approximate seconds to find the poses of ``count`` photographs, by measurements.

    The time of matching a pair grows with the square of the number of features.
    """
    part = features / MAX_FEATURES
    pairs = min(0.5 * count * (count - 1), 20.0 * count)
    features_and_pairs = 0.22 * count  # seconds of one core, as those of matching
    matching = (0.025 + 0.105 * part**2) * pairs
    placing = (0.06 + 0.24 * part) * count  # seconds on any number of cores
    return (features_and_pairs + matching) / worker_count() + placing


def features_for(count: int, seconds: float | None) -> int:
    """The most features with which poses take half of ``seconds``, else the fewest.

    The other half is for the map.
    """
    if seconds is None:
        return MAX_FEATURES
    fit = (n for n in FEATURES if seconds_to_find_poses(count, n) <= 0.5 * seconds)
    return next(fit, FEATURES[-1])


def what_does_not_fit(count: int, seconds: float | None) -> str:
    """Note or warning if the time is too short for ``count`` photographs or needs fewer features;
    empty if it is enough."""
    if seconds is None or (features := features_for(count, seconds)) == MAX_FEATURES:
        return ""
    least = seconds_to_find_poses(count, features)
    if least + LEAST_MAP <= seconds:
        return (
            f"note: For the --budget the poses are found from {features} features a photograph "
            f"instead of {MAX_FEATURES}, in about {duration(least)}."
        )
    whole = least + LEAST_MAP
    return (
        f"warning: The --budget will not do: the poses of {count} photographs take about "
        f"{duration(least)} here, and the smallest map {duration(LEAST_MAP)}, so that it takes "
        f"about {duration(whole)}. --budget {math.ceil(whole / 10) * 10}s would do, or "
        "--input.stride 2, which takes half of the photographs."
    )
