"""From photographs to a COLMAP model of the largest connected part, and the pictures left out."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geogs.errors import InputError
from geogs.io.pictures import read_mask
from geogs.io.sources.formats.colmap import mask_beside
from geogs.io.sources.known_intrinsics import calibration_from_exif, resolve_intrinsics
from geogs.io.sources.posed.stored_pictures import read_picture
from geogs.io.sources.tones import Tones, tones_of_files
from geogs.stopwatch import StageProgress
from geogs.threads import thread_map, worker_count
from geogs_photos.database import Entry, SharedCamera, known_cameras, write_database
from geogs_photos.incremental_mapping import put_together, refine
from geogs_photos.photo_features import MAX_FEATURES, PhotoFeatures, find_features
from geogs_photos.photo_pairs import Pairs, choose_pairs
from geogs_photos.photograph import Lens, PhotoFolder, Photograph
from geogs_photos.pycolmap_library import load_colmap
from geogs_photos.upright import make_upright

FEWEST_FEATURES = 50
"""Fewest features of a picture that can be matched."""
FEWEST_MATCHES = 15
"""Fewest matches of two pictures with a common view."""


@dataclass(frozen=True, slots=True)
class FoundPoses:
    """Outcome of structure from motion."""

    left_out: tuple[tuple[str, str], ...]
    """Names of photographs without a pose, each with the reason as a clause."""
    error: float
    """Mean reprojection error, pixels of the stored pictures."""


def find_poses(
    folder: PhotoFolder,
    model: Path,
    intrinsics: str,
    seed: int,
    progress: StageProgress,
    most_features: int = MAX_FEATURES,
) -> FoundPoses:
    """Find the poses of photographs, and write them as a COLMAP model.

    The world is upright, in an arbitrary unit. Pixels are those of the stored pictures.

    Args:
        folder: the photographs.
        model: folder for ``cameras.bin``, ``images.bin`` and ``points3D.bin``.
        intrinsics: as ``InputConfig.intrinsics``; fixed unless auto.
        seed: of the random choices.
        progress: follows the work.
        most_features: of a photograph; fewer take less time.

    Raises:
        InputError: pycolmap is missing, the intrinsics do not fit, or fewer than three photographs
            are connected.
    """
    load_colmap()  # fails at once if it is missing
    photographs = folder.photographs
    if len(photographs) < 3:
        raise InputError(
            f"{folder.root} holds {len(photographs)} photographs that can be read; finding their "
            "poses needs three or more."
        )
    cameras, camera_of = shared_cameras(photographs, intrinsics)
    tones = tones_of_files([photograph.path for photograph in photographs])
    features = thread_map(
        lambda p: _features(p, folder.root, most_features, tones),
        photographs,
        lambda f: progress("features", f),
    )
    pairs = choose_pairs(features, seed, lambda f: progress("choosing pairs", f))
    names = [photograph.name for photograph in photographs]
    entries = [Entry(*e) for e in zip(names, camera_of, features, strict=True)]
    with tempfile.TemporaryDirectory(prefix="geogs-photos-") as work:
        database = Path(work) / "database.db"
        parts, kept = structure_of(database, cameras, entries, pairs, seed, progress)
    left_out = [(name, "cannot be read") for name in folder.damaged]
    left_out += reasons(entries, kept, [_names(part) for part in parts])
    if not parts:
        raise InputError(_nothing_found(folder.root, entries, kept))
    progress("adjusting", 0.0)
    best = refine(parts[0], cameras)
    progress("adjusting", 1.0)
    turns = {photograph.name: photograph.quarter_turns for photograph in photographs}
    images = sorted((i for i in best.images.values() if i.has_pose), key=lambda i: i.image_id)
    make_upright(best, images, [turns[image.name] for image in images])
    best.extract_colors_for_all_images(folder.root, worker_count())
    model.mkdir(parents=True, exist_ok=True)
    best.write(model)
    return FoundPoses(tuple(left_out), float(best.compute_mean_reprojection_error()))


def structure_of(
    database: Path,
    cameras: Sequence[SharedCamera],
    entries: Sequence[Entry],
    pairs: Pairs,
    seed: int,
    progress: StageProgress,
) -> tuple[list[Any], np.ndarray]:
    """Connected parts, largest first, and the number of kept matches of any two pictures."""
    kept = write_database(
        database, cameras, entries, pairs, seed, lambda f: progress("matching", f)
    )
    parts = put_together(
        database,
        database.with_name("models"),
        len(entries),
        known_cameras(cameras),
        seed,
        lambda f: progress("finding poses", f),
    )
    return parts, kept


def shared_cameras(
    photographs: Sequence[Photograph], intrinsics: str
) -> tuple[list[SharedCamera], list[int]]:
    """One camera for all photographs with equal headers, and the index of each picture's camera."""
    lenses: dict[Lens, Photograph] = {}
    for photograph in photographs:
        lenses.setdefault(photograph.lens, photograph)
    is_known = intrinsics.strip().lower() != "auto"
    cameras = []
    for lens, photograph in lenses.items():
        nominal = None if is_known else calibration_from_exif(photograph.path)
        begin = resolve_intrinsics(intrinsics, nominal, lens.width, lens.height)
        cameras.append(SharedCamera(begin, is_known))
    places = {lens: place for place, lens in enumerate(lenses)}
    return cameras, [places[photograph.lens] for photograph in photographs]


def reasons(
    entries: Sequence[Entry], kept: np.ndarray, parts: Sequence[set[str]]
) -> list[tuple[str, str]]:
    """Names of the pictures that are not in the first part, with the reason."""
    left_out = []
    for place, entry in enumerate(entries):
        if parts and entry.name in parts[0]:
            continue
        others = next((len(part) for part in parts[1:] if entry.name in part), 0)
        shared = np.flatnonzero(kept[place] >= FEWEST_MATCHES)
        if len(entry.features) < FEWEST_FEATURES:
            reason = f"has only {len(entry.features)} features: blurred, dark or bare"
        elif others:
            reason = f"belongs to a part of {others} photographs that nothing joins to the rest"
        elif not len(shared):
            reason = "shows nothing that another photograph shows"
        else:
            most = int(kept[place].max())
            with_name = entries[int(kept[place].argmax())].name
            reason = f"shares too little with the others (most, {most} matches, with {with_name})"
        left_out.append((entry.name, reason))
    return left_out


def _features(photograph: Photograph, root: Path, most: int, tones: Tones) -> PhotoFeatures:
    """Features of a photograph, inside its mask if there is one; none if it is damaged."""
    try:
        picture = read_picture(photograph.path, tones=tones)
    except InputError:
        return PhotoFeatures.none()
    mask = mask_beside(root, photograph.name)
    inside = None if mask is None else read_mask(mask, picture.shape[:2])
    return find_features(picture, inside, most)


def _names(model: Any) -> set[str]:
    return {image.name for image in model.images.values() if image.has_pose}


def _nothing_found(root: Path, entries: Sequence[Entry], kept: np.ndarray) -> str:
    matched = int((kept >= FEWEST_MATCHES).any(axis=1).sum())
    if matched < 3:
        return (
            f"{root}: only {matched} of {len(entries)} photographs show something that another "
            "one shows; are they of one place, with much overlap from one to the next?"
        )
    return (
        f"{root}: {matched} of {len(entries)} photographs match, but no three of them tell where "
        "they were taken; take them from different places, not by turning on the spot."
    )
