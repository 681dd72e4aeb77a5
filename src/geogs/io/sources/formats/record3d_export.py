"""A recording that Record3D exported as pictures: ``metadata.json``, ``rgb`` and ``depth``.

``metadata.json`` has the content of an ``.r3d``'s ``metadata``; pictures are numbered as its poses.
"""

from pathlib import Path

from geogs.errors import InputError
from geogs.guard.documents import UNUSABLE, numbered, read_json
from geogs.io.pose_files import FRAMES_PER_SECOND
from geogs.io.sources.data_set_cameras import record3d_camera
from geogs.io.sources.formats.image_files import ImageFile, ImageList, images_in
from geogs.io.sources.formats.record3d import measured_poses

METADATA = "metadata.json"
_KEYS = {"K", "poses", "w", "h"}


def is_record3d_export(folder: Path) -> bool:
    """Whether ``folder`` holds numbered pictures in ``rgb``, and Record3D's metadata."""
    if not ((folder / METADATA).is_file() and (folder / "rgb").is_dir()):
        return False
    try:
        said = read_json(folder / METADATA)
    except InputError:
        return False
    return isinstance(said, dict) and said.keys() >= _KEYS


def open_record3d_export(folder: Path) -> ImageList:
    """Read the pictures of an export, with their poses; EXR depth is not read.

    Raises:
        InputError: there is no picture, or the metadata cannot be understood.
    """
    said = read_json(folder / METADATA)
    try:
        fps = float(said.get("fps") or FRAMES_PER_SECOND)
        calibration = record3d_camera(said)
        poses = measured_poses(said["poses"])
        times = [float(t) for t in said.get("frameTimestamps") or []]
        if not 0 < fps < 1e4:
            raise ValueError(f"{fps} frames a second")
    except UNUSABLE:
        raise InputError(f"{folder / METADATA} cannot be understood; export it again.") from None
    pictures = dict(numbered(images_in(folder / "rgb")))
    if not pictures:
        raise InputError(f"{folder / 'rgb'} holds no numbered pictures; export it again.")
    files = [
        ImageFile(path, times[k] if k < len(times) else k / fps, pose=poses.get(k))
        for k, path in pictures.items()
    ]
    has_depth = next((folder / "depth").glob("*.exr"), None) is not None
    fault = "depth in EXR is not read; Record3D's .r3d of the same recording has it, too"
    return ImageList(
        "record3d",
        _name(folder),
        files,
        calibration,
        bool(poses),
        is_capture=True,
        depth_fault=fault if has_depth else "",
    )


def _name(folder: Path) -> str:
    """Name of the recording; the parent's where the folder has the default export name."""
    whole = folder.resolve()
    return whole.parent.name if whole.name.upper() == "EXR_RGBD" else whole.name
