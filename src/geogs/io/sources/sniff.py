"""Open a source of any format, which is detected by content."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from geogs.config import InputConfig
from geogs.config.arguments import checks_arguments
from geogs.errors import InputError
from geogs.guard.documents import expanded, require_file
from geogs.io.sources.address import LiveAddress, live_address
from geogs.io.sources.formats import (
    bundler,
    colmap,
    dtu,
    kapture,
    metashape,
    mvsnet,
    nerfstudio,
    openmvg,
    opensfm,
    realitycapture,
    record3d,
)
from geogs.io.sources.formats.image_files import (
    SUFFIXES,
    ImageFile,
    ImageList,
    image_folder,
    open_image_folder,
)
from geogs.io.sources.formats.model_layouts import open_posed_photographs, place_of_model
from geogs.io.sources.frame_source import Source
from geogs.io.sources.known_intrinsics import calibration_from_exif
from geogs.io.sources.known_layouts import LAYOUTS, WITH_MODEL
from geogs.io.sources.layouts import found_below, found_in, what_is_missing
from geogs.io.sources.posed.posed_set import PosedSet
from geogs.io.sources.posed.posed_source import PosedSource
from geogs.io.sources.reader import Reader
from geogs.io.sources.ros.bag import Bag, is_bag
from geogs.io.sources.views import taken
from geogs.io.sources.working_images import WorkingImages

# Data sets with their own description often have one of these as well.
_POSED_FORMATS: tuple[tuple[str, Callable[[Path], object], Callable[[Path], PosedSet]], ...] = (
    ("DTU cameras.npz", dtu.is_dtu, dtu.open_dtu),
    ("nerfstudio transforms.json", nerfstudio.find_transforms, nerfstudio.open_nerfstudio),
    ("COLMAP model", colmap.find_model, colmap.open_colmap),
)
_EXPORTS: tuple[tuple[str, Callable[[Path], Path | None], Callable[[Path], PosedSet]], ...] = (
    ("OpenSfM", opensfm.find_opensfm, opensfm.open_opensfm),
    ("Metashape", metashape.find_metashape, metashape.open_metashape),
    ("OpenMVG", openmvg.find_openmvg, openmvg.open_openmvg),
    ("RealityCapture", realitycapture.find_csv, realitycapture.open_csv),
    ("RealityCapture", realitycapture.find_xmp, realitycapture.open_xmp),
    ("MVSNet", mvsnet.find_mvsnet, mvsnet.open_mvsnet),
    ("Kapture", kapture.find_kapture, kapture.open_kapture),
    ("Bundler", bundler.find_bundler, bundler.open_bundler),
    ("VisualSFM", bundler.find_nvm, bundler.open_nvm),
)
"""Lists of views by other programs, in a folder after the formats above: name, how the file is
found, and how it is opened."""
_POSED_LAYOUTS = tuple(layout for layout in LAYOUTS if layout.posed)

_log = logging.getLogger(__name__)


@checks_arguments
def open_source(
    path: str | Path | Sequence[str | Path], config: InputConfig | None = None
) -> Source:
    """Open a video, a folder of images, a bag of ROS, or a sequence of a data set.

    The format follows from the content; of a data set (``known_layouts.py``) the folder may be that
    of the sequence, of its images, or one that holds no other sequence. Ground truth that lies
    beside the images is not read.
    ``camera:0``, an URL such as ``rtsp://…``, ``-`` (raw frames from standard input) and
    ``play:FILE`` (a file in real time) are live: each read gives the newest frame.

    Args:
        path: the file or folder; several of one scene, by one camera, become one stream.
        config: selection of frames, intrinsics and working resolution; the defaults if none.

    Raises:
        InputError: nothing usable is there, ``config`` does not fit it, or the cameras differ.
    """
    paths = [path] if isinstance(path, str | Path) else path
    config = config or InputConfig()
    if not paths:
        raise InputError("Nothing to read; give a video or a folder of images.")
    addresses = [live_address(one) for one in paths]
    if len(paths) > 1 and any(addresses):
        raise InputError(
            "A camera, a stream or a pipe is read alone; give no other source with it."
        )
    if any(addresses) and config.take not in ("auto", "none"):
        raise InputError("take cuts recordings only; record the live source, or leave out --take.")
    readers = (
        taken(_reader(expanded(one), config), config.take)
        if address is None
        else _live_reader(address, config)
        for one, address in zip(paths, addresses, strict=True)
    )
    return Source([WorkingImages(reader, config) for reader in readers])


def open_picture(path: Path, config: InputConfig) -> Source:
    """Open a single picture as a source of one frame.

    Raises:
        InputError: it cannot be read, or ``config`` does not fit it.
    """
    path = require_file(expanded(path))
    calibration = calibration_from_exif(path)
    picture = ImageList("picture", path.name, [ImageFile(path, 0.0)], calibration)
    return Source([WorkingImages(picture, config)])


def _live_reader(address: LiveAddress, config: InputConfig) -> Reader:
    from geogs.io.sources.live.feeds import open_live  # loads OpenCV

    is_played = address.kind == "play"
    played = _reader(expanded(address.target), config) if is_played else None
    return open_live(address, config.pipe, played)


def _reader(path: Path, config: InputConfig) -> Reader:
    topic = config.topic
    try:
        if path.exists() and is_bag(path):
            return Bag(path, topic)
        if topic != "auto":
            raise InputError(f"{path} is no bag of ROS, which alone has topics; leave out --topic.")
        if path.exists() and record3d.is_record3d(path):
            return record3d.Record3dRecording(path)
        if path.is_dir():
            return _folder_reader(path, config.poses.strip().lower() == "prior")
        if not path.exists():
            raise InputError(f"{path} does not exist; give a video or a folder of images.")
        if path.suffix.lower() in SUFFIXES:
            raise InputError(f"{path} is a single picture; give a video or a folder of images.")
        if path.stat().st_size == 0:
            raise InputError(f"{path} is empty; is the copy or download complete?")
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    from geogs.io.sources.formats.video_file import VideoFile  # loads FFmpeg

    return VideoFile(path)


def _folder_reader(folder: Path, wants_poses: bool) -> Reader:
    found = found_in(folder, LAYOUTS)
    if found is None and image_folder(folder) is None:
        found = found_below(folder, LAYOUTS)
        if found is None and (sentence := what_is_missing(folder, LAYOUTS)):
            raise InputError(sentence)
    if found is not None:
        layout, place = found
        _log.info("%s is read as %s: %s.", folder, layout.name, place.pictures)
        return layout.open(place)
    images = open_image_folder(folder)
    return nerfstudio.with_transforms(images, folder) if wants_poses else images


@checks_arguments
def open_posed_source(
    path: str | Path, config: InputConfig | None = None, hold_out: int | None = None
) -> PosedSource:
    """Open an image set together with its known poses.

    The format follows from the content: a COLMAP model, nerfstudio's ``transforms.json``, DTU's
    ``cameras.npz``, a list of views by another program (``_EXPORTS``), or one of the data sets of
    ``known_layouts.py`` with its true poses.

    Args:
        path: the folder, or the file with the poses.
        config: selection of images, intrinsics and working resolution; the defaults if none.
        hold_out: every ``hold_out``-th of the selected images is left out; none keeps all.

    Raises:
        InputError: no images with poses are there, or they cannot be used.
    """
    path = expanded(path)
    try:
        return PosedSource(_posed_set(path), config or InputConfig(), hold_out)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error


def _posed_set(path: Path) -> PosedSet:
    if not path.exists():
        raise InputError(f"{path} does not exist; give a folder of images with poses.")
    exports = [(name, f, opened) for name, find, opened in _EXPORTS if (f := find(path))]
    if path.is_file():
        if exports:
            _, file, open_file = exports[0]
            return _timed_as_read(open_file(file), path.parent)
        if nerfstudio.find_transforms(path):
            return _timed_as_read(nerfstudio.open_nerfstudio(path), path.parent)
        path = path.parent if path.suffix in (".npz", ".bin", ".txt") else path
    if path.is_dir():
        if place := place_of_model(path):
            return open_posed_photographs(place)
        found = found_in(path, WITH_MODEL)
        formats = [one for one in _POSED_FORMATS if found is None and one[1](path)]
        if formats:
            posed = _without(exports, _timed_as_read(formats[0][2](path), path))
            for name, _, _ in formats[1:]:
                posed = posed.left(f"the {name}, as the other poses are there")
            return posed
        found = found or found_in(path, _POSED_LAYOUTS)
        if found is None and exports:
            _, file, open_file = exports[0]
            return _without(exports[1:], _timed_as_read(open_file(file), path))
        found = found or found_below(path, _POSED_LAYOUTS)
        if found is not None and (open_posed := found[0].posed):
            return _without(exports, open_posed(found[1]))
    raise InputError(
        f"{path} holds no images with known poses (COLMAP, nerfstudio, DTU, OpenSfM, Metashape, "
        "OpenMVG, RealityCapture, MVSNet, Kapture, Bundler, or a data set with its true poses); "
        "use --sfm for photographs, geogs run for a video."
    )


def _without(exports: Sequence[tuple[str, Path, object]], posed: PosedSet) -> PosedSet:
    """Name the lists of views that are not used."""
    for name, file, _ in exports:
        posed = posed.left(f"{file} of {name}, as the other poses are there")
    return posed


def _timed_as_read(posed: PosedSet, folder: Path) -> PosedSet:
    """Give the images the times that they have when read without poses, so that a trajectory of
    ``geogs run`` is matched to the right ones where some images have no pose."""
    for place in (folder, posed.files[0].path.parent) if posed.files else ():
        try:
            images = _folder_reader(place, wants_poses=False)
        except InputError:
            continue
        listed = images.files if isinstance(images, ImageList) else ()
        times = {file.path.resolve(): file.timestamp for file in listed}
        if all(file.path.resolve() in times for file in posed.files):
            files = (replace(file, timestamp=times[file.path.resolve()]) for file in posed.files)
            return replace(posed, files=tuple(files))
    return posed
