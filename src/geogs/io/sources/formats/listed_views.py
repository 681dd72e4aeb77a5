"""Views that another program lists: names, poses and cameras, and the image set that they make."""

import functools
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from geogs.errors import InputError
from geogs.guard.documents import UNUSABLE, in_short, open_file
from geogs.io.pose_files import FRAMES_PER_SECOND
from geogs.io.sources.account import Account, named
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.formats.colmap import mask_beside
from geogs.io.sources.formats.image_files import has_images, images_in, natural_key
from geogs.io.sources.named_files import IMAGE_FOLDERS, NamedFiles, elsewhere
from geogs.io.sources.posed.posed_set import PosedFile, PosedSet
from geogs.io.sources.posed.stored_pictures import has_alpha, stored_size

SizedCamera = Callable[[int, int], Calibration | None]
"""A camera by width and height of the picture in pixels; none where it is unknown. Raises
InputError for one that is not supported."""
LEAST_SHIFT = 0.5
"""Largest shift, in pixels in the corners of the image, by a term of a lens that is neglected."""
_FOLDERS = (*IMAGE_FOLDERS, "photos", "pictures", "blended_images", "records_data", "sensors")
"""Folders of the images of a project."""
_HEAD = 1 << 16
"""Bytes at the beginning of a file that tell its format."""
_RADII = 500
"""Radii at which a lens is fitted."""
_FITTED = 0.05
"""Largest error of such a fit in pixels."""


@dataclass(frozen=True, slots=True)
class View:
    """An image that a program lists with its pose."""

    name: str
    T_cw: Float64[np.ndarray, "4 4"]
    """World to camera, OpenCV axes; anything else where the file holds no rigid pose."""
    camera: Calibration | SizedCamera | None
    """Its camera; none where the file does not tell."""


@contextmanager
def understood(file: Path, remedy: str = "export it again") -> Iterator[None]:
    """Raise one InputError for whatever invalid values in a file cause."""
    try:
        yield
    except UNUSABLE:
        raise InputError(f"{file} cannot be understood; {remedy}.") from None


def pose(
    rotation: Float64[np.ndarray, "3 3"], translation: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "4 4"]:
    """A pose of rotation and translation."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation
    return T


def pose_at(
    rotation: Float64[np.ndarray, "3 3"], centre: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "4 4"]:
    """World to camera, of the rotation and of the camera's place in the world."""
    return pose(rotation, -np.asarray(rotation) @ np.asarray(centre))


def refused(what: str, file: Path) -> SizedCamera:
    """A camera that is not supported; ``what`` may hold a word of the file."""
    said = what if re.fullmatch(r"[\w .-]{1,60}", what) else "a camera of an unknown type"

    def refuse(width: int, height: int) -> Calibration | None:
        raise InputError(f"{file} describes {said}, which is not supported; undistort the images.")

    return refuse


def find_file(path: Path, patterns: Sequence[str], *marks: bytes) -> Path | None:
    """The file that ``path`` is, or the first in a folder that fits a pattern, with all marks near
    its beginning, whatever their case; none if there is none."""
    return next(iter(find_files(path, patterns, *marks)), None)


def find_files(path: Path, patterns: Sequence[str], *marks: bytes) -> Iterator[Path]:
    """All such files."""
    places = [path] if path.is_file() else (p for name in patterns for p in sorted(path.glob(name)))
    return (p for p in places if p.is_file() and _begins_with(p, marks))


def _begins_with(path: Path, marks: Sequence[bytes]) -> bool:
    try:
        with open_file(path) as stream:
            head = stream.read(_HEAD).lower()
    except InputError:
        return False
    return all(mark.lower() in head for mark in marks)


def posed_set(
    kind: str,
    file: Path,
    views: Iterable[View],
    without_pose: Sequence[str] = (),
    account: Account | None = None,
    *folders: Path,
) -> PosedSet:
    """The image set of the views, in natural order of their names.

    Args:
        kind: name of the format.
        file: what lists the views, for messages.
        views: those with a pose.
        without_pose: names of the others.
        account: what else the file holds.
        folders: those of the images; those around ``file`` if none.

    Raises:
        InputError: there are no views, or no camera is supported.
    """
    ordered = sorted(views, key=lambda view: natural_key(view.name))
    if not ordered:
        raise InputError(f"{file} lists no image with a pose; export it after the alignment.")
    counts = Counter(view.name for view in ordered)
    twice = [name for name, count in counts.items() if count > 1]
    ordered = [view for view in ordered if counts[view.name] == 1]
    names = [view.name for view in ordered]
    places = [folders] if folders else _folders_of(file)
    located = [(NamedFiles(*some), some[0]) for some in places]
    found, root = max(located, key=lambda place: sum(map(bool, place[0].find(names))))
    paths = found.find(names)
    unposed = found.find(without_pose)
    files: list[PosedFile] = []
    failures: dict[str, InputError] = {}
    for view, path in zip(ordered, paths, strict=True):
        path = path or file.parent / view.name.replace("\0", "")
        try:
            with understood(file):
                files.append(_posed_file(view, path, len(files)))
        except InputError as error:
            failures[path.name] = error
    if failures and not files:
        raise next(iter(failures.values()))
    reason = "".join(str(error).rstrip(".") for error in [*failures.values()][:1])
    total = len(ordered) + len(without_pose)
    listed = {path for path in (*paths, *unposed) if path}
    others = {p for folder in {path.parent for path in listed} for p in images_in(folder)} - listed
    reasons = (
        (without_pose, f"of {total} images that {file} lists without a pose"),
        (twice, f"names that {file} lists more than once"),
        (list(failures), f"images by cameras that are not supported: {reason}"),
        (sorted(path.name for path in others), f"pictures beside them that {file} does not list"),
    )
    left = tuple(
        f"{len(n)} {reason} ({named([in_short(name) for name in n])})" for n, reason in reasons if n
    )
    said = Account((f"poses and cameras of {file}",), left) + (account or Account())
    said += elsewhere(names, paths)
    return PosedSet(kind, _name(root.resolve()), tuple(files), account=said)


def _posed_file(view: View, path: Path, index: int) -> PosedFile:
    size = stored_size(path)
    camera = view.camera
    if callable(camera):
        camera = None if size is None else camera(*size)
    mask = mask_beside(path.parent, path.name) or (path if has_alpha(path) else None)
    return PosedFile(path, view.T_cw, camera, mask, index / FRAMES_PER_SECOND)


def _folders_of(file: Path) -> list[tuple[Path, ...]]:
    """Where the images of a file may be: beside it, in a folder of images there or in the only one
    with images, or one or two folders above."""
    here = file.resolve().parent
    found = []
    for base in (here, here.parent, here.parent.parent):
        usual = [base / name for name in _FOLDERS if (base / name).is_dir()]
        found.append((base, *usual))
    others = [place for place in here.iterdir() if place.is_dir() and has_images(place)]
    return [*found, (here, *others)] if len(others) == 1 else found


def _name(folder: Path) -> str:
    """Name of a scene by a folder of its images, or of the whole."""
    return next((p.name for p in (folder, *folder.parents) if p.name not in _FOLDERS), "")


def brown_lens(
    focal: tuple[float, float],
    centre: tuple[float, float],
    radial: Sequence[float],
    tangential: tuple[float, float],
    size: tuple[int, int],
    origin: str,
    account: Account | None = None,
) -> Calibration:
    """A camera whose lens has up to four radial terms, of which OpenCV has three.

    A fourth is expressed by a quotient of polynomials, fitted over the image.

    Args:
        focal: fx and fy in pixels.
        centre: principal point, pixel centres at integers.
        radial: k1, k2, k3, k4.
        tangential: p1, p2 as OpenCV orders them.
        size: width and height of the images.
        origin: for messages.
        account: what else is said of it.
    """
    k1, k2, k3, k4 = (float(k) for k in radial)
    more = [k3]
    if k4:
        corner = math.hypot(*size) / 2 / min(focal)
        (k1, k2, *more), error = _quotient((k1, k2, k3, k4), corner)
        if error * min(focal) > _FITTED:
            raise InputError(f"The lens ({origin}) is too strange; undistort the images first.")
    distortion = (k1, k2, *tangential, *more)
    account = account or Account()
    return Calibration(*focal, *centre, distortion, *size, origin=origin, account=account)


@functools.lru_cache(64)
def _quotient(radial: tuple[float, ...], corner: float) -> tuple[tuple[float, ...], float]:
    """k1 to k6 of OpenCV's quotient like four radial terms up to the corner; the error there.

    Linear least squares of numerator - denominator · polynomial.
    """
    radius = np.linspace(0, 3 * corner, 3 * _RADII)
    square = np.square(radius)
    factor = 1 + np.stack([square, square**2, square**3, square**4], 1) @ radial
    seen = radius * factor
    ends = (seen > corner) | (np.gradient(seen) <= 0)
    used = slice(1, max(_RADII // 10, int(np.argmax(ends)) if ends.any() else len(ends)))
    powers = np.stack([square[used] ** n for n in (1, 2, 3)], 1)
    wanted = factor[used]
    weight = radius[used, None]
    system = np.concatenate([powers, -wanted[:, None] * powers], 1) * weight
    found = np.linalg.lstsq(system, (wanted - 1) * weight[:, 0], rcond=None)[0]
    fitted = (1 + powers @ found[:3]) / (1 + powers @ found[3:])
    return tuple(found.tolist()), float(np.abs((fitted - wanted) * radius[used]).max())


def check_neglected(terms: dict[str, float], file: Path) -> Account:
    """An account of terms of a lens that are not supported and too small to matter.

    Args:
        terms: names of the terms, with their shifts in the corners of the image in pixels.
        file: for messages.

    Raises:
        InputError: one shifts more than ``LEAST_SHIFT``.
    """
    small = [name for name, shift in terms.items() if shift and abs(shift) < LEAST_SHIFT]
    if large := [name for name, shift in terms.items() if not abs(shift) < LEAST_SHIFT]:
        most = max(abs(terms[name]) for name in large)
        raise InputError(
            f"{file}: {', '.join(large)} of a lens, of {most:.1f} pixels in the corners, cannot be "
            "used here; align without, or export undistorted images with their cameras."
        )
    said = f"{', '.join(small)} of the lens in {file}, below {LEAST_SHIFT} pixels"
    return Account(left=(said,) if small else ())
