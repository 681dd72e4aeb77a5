"""Images as files: a folder of photographs or frames, and the list that the data sets share."""

import logging
import math
import os
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from geogs.errors import InputError
from geogs.guard.documents import read_text
from geogs.io.pictures import DEEP, decoded, stored_size_and_turns, upright_size
from geogs.io.pose_files import FRAMES_PER_SECOND
from geogs.io.sources.account import Account, named
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.depth_files import DepthFile
from geogs.io.sources.formats.chosen_pictures import frames_among, time_from_name, unread
from geogs.io.sources.formats.image_times import listed_times, spacing
from geogs.io.sources.known_intrinsics import calibration_from_exif, find_calibration
from geogs.io.sources.reader import RawFrame, RecordingInfo, median_rate
from geogs.io.sources.tones import tones_of_files
from geogs.types import MeasuredPose

SUFFIXES = frozenset(
    {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".avif", ".ppm", ".pgm"}
)
"""Suffixes of image files."""

# Where other tools put the images of a project.
_SUBFOLDERS = ("images", "image", "rgb", "color", "frames", "data", "mav0/cam0/data")
SLOWEST, FASTEST = 0.05, 1000.0
"""Images a second beyond which their times are said to be unusual."""
_DEPTHS = ("depth", "depths", "Depth", "depth_images", "aligned_depth")
"""Names of folders of depth images."""
_ASKED = 24
"""Approximate number of images whose size is read, or of depth images that are tested."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ImageFile:
    """An image on disk and when it was taken, in seconds."""

    path: Path
    timestamp: float
    depth: DepthFile | None = None
    """Sensor depth at that time."""
    pose: MeasuredPose | None = None
    """Pose by another tracker."""


@dataclass(frozen=True)
class Place:
    """A sequence of a data set on disk."""

    folder: Path
    """Folder of the sequence."""
    pictures: Path
    """Folder of the images; the sequence's where the layout names none."""


class ImageList:
    """Reader of image files; the most frequent size is that of the recording."""

    def __init__(
        self,
        kind: str,
        name: str,
        files: Sequence[ImageFile],
        calibration: Calibration | None,
        has_poses: bool = False,
        is_capture: bool = False,
        depth_fault: str = "",
        account: Account | None = None,
    ) -> None:
        """At least one image in order of time; see :class:`RecordingInfo` for the description.

        Raises:
            InputError: none of them can be read, or most have one time.
        """
        files, repeated = without_repeated(files, name)
        self.files = files
        depths = [file.depth for file in files if file.depth is not None]
        asked = depths[:: max(1, len(depths) // _ASKED)]
        can_be_read = any(depth.metres() is not None for depth in asked)
        if depths and not can_be_read:
            depth_fault = f"none of its pictures of depth can be read, such as {depths[0].path}"
        usual = usual_file(files)
        candidates = (decoded(file.path, DEEP).picture for file in (usual, *files))
        image = next((image for image in candidates if image is not None), None)
        if image is None:
            raise InputError(f"{name}: none of its {len(files)} images can be read.")
        height, width = image.shape[:2]
        fps = median_rate(np.diff([file.timestamp for file in files]))
        if not SLOWEST <= fps <= FASTEST:
            repeated += Account((f"times: {fps:.2g} images a second; are they in seconds?",))
        self._tones = tones_of_files([file.path for file in files])
        self.info = RecordingInfo(
            kind,
            name,
            width,
            height,
            fps=fps,
            length=len(files),
            calibration=calibration,
            quarter_turns=stored_size_and_turns(usual.path)[1],
            depths=len(depths) if can_be_read else 0,
            depth_sample=tuple(asked),
            depth_fault=depth_fault,
            has_poses=has_poses,
            is_capture=is_capture,
            seconds=files[-1].timestamp,
            first_time=files[0].timestamp,
            account=self._tones.account + (account or Account()) + repeated,
        )

    @property
    def paths(self) -> list[Path]:
        """The files that are read."""
        return [file.path for file in self.files]

    def spread(self, starts: Sequence[int]) -> Iterator[RawFrame]:
        """Read the images at these indices."""
        for start in starts:
            yield from self.read(start, start + 1, 1)

    def read(self, start: int, stop: int | None, stride: int) -> Iterator[RawFrame]:
        """Read images ``start, start + stride, ...`` before ``stop``."""
        for file in self.files[start:stop:stride]:
            found = decoded(file.path, DEEP)
            yield RawFrame(
                str(file.path),
                file.timestamp,
                self._tones.rgb(found.picture),
                found.is_damaged,
                depth=file.depth,
                pose=file.pose,
                name=file.path.name,
            )


def open_image_folder(folder: Path) -> ImageList:
    """Read a folder of images, or its sub-folder that holds them, in order of time or name."""
    place = image_folder(folder)
    if place is None:
        raise InputError(
            without_images(folder)
            or f"{folder} holds no images ({', '.join(sorted(SUFFIXES))}) and is no data set known "
            "here; give a video, a folder of images, or a sequence of a data set as it was "
            "unpacked."
        )
    found = images_in(place)
    frames, others = frames_among(found)
    # What describes the images lies with them, or above a folder called images.
    above = [place.parent] if place.resolve().name in _SUBFOLDERS else []
    folders = [*dict.fromkeys((folder, place, *above))]
    files, times = _timed(frames, folders)
    depths = _unread_depth(folders, place)
    account = times + Account(left=(*others, *unread(file_names(place), found), *depths))
    calibration = find_calibration(*folders) or calibration_from_exif(usual_file(files).path)
    return ImageList("images", folder.resolve().name, files, calibration, account=account)


def without_repeated(files: Sequence[ImageFile], name: str) -> tuple[Sequence[ImageFile], Account]:
    """Images without those that have the time of the one before, and a sentence on these.

    Raises:
        InputError: they are most of the images.
    """
    repeated = [b for a, b in pairwise(files) if a.timestamp == b.timestamp]
    if not repeated:
        return files, Account()
    count = f"{len(repeated)} of {len(files)} images"
    if 2 * len(repeated) > len(files):
        raise InputError(
            f"{name}: {count} have the time of the one before; give times with fractions of a "
            "second."
        )
    names = named([file.path.name for file in repeated])
    kept = [files[0], *(b for a, b in pairwise(files) if a.timestamp != b.timestamp)]
    return kept, Account(left=(f"{count}, which have the time of the one before ({names})",))


def _unread_depth(folders: Sequence[Path], place: Path) -> list[str]:
    """A sentence on a folder of depth beside the images, whose layout is not known."""
    found = (folder / name for folder in folders for name in _DEPTHS if folder / name != place)
    return [
        f"pictures in {folder.name}: depth is read by lists (TUM's rgb.txt and depth.txt), or "
        "beside a folder color with the same numbers"
        for folder in found
        if has_images(folder)
    ][:1]


def _timed(paths: Sequence[Path], folders: Sequence[Path]) -> tuple[list[ImageFile], Account]:
    """Images in order of time, by their names or a list in one of the folders, and how."""
    if files := timed_by_names(paths):
        apart = spacing(np.array([file.timestamp for file in files]))
        return files, Account((f"times: those in the names, {apart}",))
    files = in_order_of_time(paths)
    times, account = listed_times([file.path for file in files], folders)
    files = [replace(file, timestamp=float(t)) for file, t in zip(files, times, strict=True)]
    return sorted(files, key=lambda file: file.timestamp), account


def without_images(folder: Path) -> str:
    """Message on a folder whose pictures are all of kinds that are not read here; empty if it holds
    none."""
    for place in _places(folder):
        if place.is_dir() and (kinds := unread(file_names(place))):
            return f"{place} holds no images that can be read: {', '.join(kinds)}."
    return ""


def depths_there(files: Sequence[ImageFile], listing: Path) -> tuple[list[ImageFile], str]:
    """Return the images without depths that are listed but missing, and the fault if all are.

    Each folder is listed once. The log gives the number of missing files.
    """
    paths = [file.depth.path for file in files if file.depth is not None]
    folders = {path.parent for path in paths}
    there = {folder / name for folder in folders if folder.is_dir() for name in file_names(folder)}
    missing = [path for path in paths if path not in there]
    if not missing:
        return list(files), ""
    gone = set(missing)
    kept = [
        replace(file, depth=None) if file.depth is not None and file.depth.path in gone else file
        for file in files
    ]
    if len(missing) == len(paths):
        return kept, f"{listing} names {len(paths)} pictures of depth, of which none is there"
    lacking = f"{len(missing)} of {len(paths)} pictures of depth are missing"
    _log.warning("%s: %s, such as %s.", listing, lacking, missing[0].name)
    return kept, ""


def listed(
    listing: Path,
    read: Callable[[Path, list[str]], ImageFile],
    expected: str,
    between: str | None = None,
) -> list[ImageFile]:
    """Images of a list in order of time; in its rows ``#`` begins a comment.

    Args:
        listing: the file.
        read: an image of the list's folder and the words of a row. Raises ValueError.
        expected: content of a row, for the error message.
        between: separator of words; white space if none.

    Raises:
        InputError: a row holds something else, or there is no row.
    """
    files = []
    for number, line in enumerate(read_text(listing).splitlines(), start=1):
        row = line.split("#", 1)[0].strip()
        if not row:
            continue
        try:
            files.append(read(listing.parent, [word.strip() for word in row.split(between)]))
        except ValueError:
            raise InputError(f"{listing}, line {number}: expected {expected}.") from None
    if not files:
        raise InputError(f"{listing} lists no images.")
    return sorted(files, key=lambda file: file.timestamp)


def finite(value: Any) -> float:
    """Return a value as a finite number. Raises ValueError or TypeError if it is none."""
    number = float(value)
    if not math.isfinite(number):
        raise ValueError
    return number


def usual_file(files: Sequence[ImageFile]) -> ImageFile:
    """Return the first image of the most frequent size in a sample of the list; the first of all
    if none can be read."""
    asked = files[:: max(1, len(files) // _ASKED)]
    sizes = [upright_size(file.path) for file in asked]
    counts = Counter(size for size in sizes if size is not None)
    return asked[sizes.index(counts.most_common(1)[0][0])] if counts else files[0]


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key that puts ``frame10`` after ``frame9``: runs of digits compare as numbers."""
    key = []
    for part in filter(None, re.split(r"(\d+)", name.lower())):
        if part.isdecimal():  # of two numbers the longer is larger; they may be too long for an int
            digits = "".join(str(unicodedata.decimal(c)) for c in part).lstrip("0")
            key.append((0, len(digits), digits))
        else:
            key.append((1, 0, part))
    return key


def in_order_of_time(paths: Sequence[Path]) -> list[ImageFile]:
    """Sort images by the times in their names, or naturally with image k at k / 30 s."""
    ordered = sorted(paths, key=lambda path: (natural_key(path.name), path.name))
    numbered = [ImageFile(path, k / FRAMES_PER_SECOND) for k, path in enumerate(ordered)]
    return timed_by_names(paths) or numbered


def timed_by_names(paths: Sequence[Path]) -> list[ImageFile]:
    """Sort images by the times in their names (``image_times.py``); none where some name is no time
    or that of another."""
    times = {time: path for path in paths if (time := time_from_name(path.stem)) is not None}
    if len(times) < len(paths):
        return []
    return [ImageFile(path, time) for time, path in sorted(times.items())]


def image_folder(folder: Path) -> Path | None:
    """The folder itself or the sub-folder of a usual name that holds images; none if none does."""
    return next((place for place in _places(folder) if place.is_dir() and images_in(place)), None)


def _places(folder: Path) -> list[Path]:
    return [folder, *(folder / name for name in _SUBFOLDERS)]


def has_images(folder: Path) -> bool:
    """Whether there is a folder with an image in it; the first is enough."""
    try:
        with os.scandir(folder) as entries:
            return any(_is_image(entry.name) for entry in entries)
    except OSError:
        return False


def holds_pictures(folder: Path, names: Sequence[str]) -> bool:
    """Whether there are images in one of the named folders below."""
    return any(has_images(folder / name) for name in names)


def images_in(folder: Path) -> list[Path]:
    """The images in a folder, in no order."""
    return [folder / name for name in file_names(folder) if _is_image(name)]


def _is_image(name: str) -> bool:
    return Path(name).suffix.lower() in SUFFIXES and not name.startswith(".")


def file_names(folder: Path) -> list[str]:
    """Names of the files in a folder, read in one pass."""
    with os.scandir(folder) as entries:  # only links need another system call
        return [e.name for e in entries if (Path(e) if e.is_symlink() else e).is_file()]
