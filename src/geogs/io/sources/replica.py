"""Replica as rendered for iMAP: ``results/frame000000.jpg, ...``, ``cam_params.json``."""

import re
from pathlib import Path

from geogs.io.poses import FRAMES_PER_SECOND
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.calibration_files import read_calibration
from geogs.io.sources.images import ImageFile, ImageList

_NAME = re.compile(r"frame(\d+)\.(jpg|jpeg|png)", re.IGNORECASE)
_CAMERA = Calibration(
    600.0, 600.0, 599.5, 339.5, width=1200, height=680, origin="the Replica data set"
)  # fmt: skip


def is_replica(folder: Path) -> bool:
    """Whether ``folder`` is a scene, or the ``results`` folder of one."""
    results = _results(folder)
    return results.is_dir() and any(_NAME.fullmatch(path.name) for path in results.iterdir())


def open_replica(folder: Path) -> ImageList:
    """Read a scene; frame k is at k / 30 s, which matches line k of ``traj.txt``."""
    results = _results(folder)
    scene = results.parent.resolve()
    matches = ((_NAME.fullmatch(path.name), path) for path in results.iterdir())
    numbered = sorted((int(match[1]), path) for match, path in matches if match)
    files = [ImageFile(path, number / FRAMES_PER_SECOND) for number, path in numbered]
    reader = ImageList("replica", scene.name, files, None)
    reader.calibration = _find_calibration(scene, reader.width, reader.height)
    return reader


def _results(folder: Path) -> Path:
    return folder if folder.name == "results" else folder / "results"


def _find_calibration(scene: Path, width: int, height: int) -> Calibration | None:
    for place in (scene, scene.parent):
        if (place / "cam_params.json").is_file():
            return read_calibration(place / "cam_params.json")
    return _CAMERA if (width, height) == (1200, 680) else None
