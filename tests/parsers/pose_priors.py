"""Poses beside the images."""

from pathlib import Path

import mutations
from geogs.config import InputConfig
from geogs.io.sources.sniff import open_source
from io_samples import write_images
from parsers.base import Parser
from pose_samples import (
    walked,
    write_polycam,
    write_record3d,
    write_record3d_export,
    write_stray,
    write_transforms,
    write_tum_poses,
)

PATH = walked(3)


def pose_priors() -> dict[str, Parser]:
    """By what is damaged."""
    return {
        "stray-odometry": Parser(stray, ("odometry.csv",), mutations.text, poses_of("auto")),
        "record3d-metadata": Parser(record3d, ("metadata",), mutations.json_text, poses_of("auto")),
        "record3d-export": Parser(
            exported, ("EXR_RGBD/metadata.json",), mutations.json_text, poses_of("auto")
        ),
        "record3d-archive": Parser(archived, ("room.r3d",), mutations.binary, archive_poses),
        "polycam-camera": Parser(
            polycam,
            ("keyframes/cameras/1442008775605.json",),
            mutations.json_text,
            poses_of("auto"),
        ),
        "transforms-prior": Parser(
            transforms, ("transforms.json",), mutations.json_text, poses_of("prior")
        ),
        "poses-file": Parser(tum, ("poses.txt",), mutations.text, file_poses),
    }


def poses_of(asked: str):
    """Reads the poses of a source."""

    def read(folder: Path) -> object:
        config = InputConfig(intrinsics="50,50,31.5,23.5", poses=asked, readout=0.0)
        return [f.pose for f in open_source(folder, config)]

    return read


def archive_poses(folder: Path) -> object:
    """Those of an archive."""
    return poses_of("auto")(folder / "room.r3d")


def file_poses(folder: Path) -> object:
    """Those of a file by name."""
    return poses_of(str(folder / "poses.txt"))(folder / "v")


def stray(folder: Path) -> None:
    write_stray(folder, PATH)


def record3d(folder: Path) -> None:
    write_record3d(folder, PATH).unlink()


def archived(folder: Path) -> None:
    write_record3d(folder / "room", PATH)


def exported(folder: Path) -> None:
    write_record3d_export(folder, PATH)


def polycam(folder: Path) -> None:
    write_polycam(folder, PATH)


def transforms(folder: Path) -> None:
    write_transforms(folder, PATH)


def tum(folder: Path) -> None:
    write_images(folder / "v", ["0.png", "1.png", "2.png"])
    write_tum_poses(folder / "poses.txt", PATH, 1 / 30)
