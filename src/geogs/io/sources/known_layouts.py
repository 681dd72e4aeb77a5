"""The known layouts of data sets, in the order in which they are tried."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from geogs.io.sources.formats import (
    arkitscenes,
    asl,
    icl_nuim,
    kitti,
    kitti_raw,
    model_layouts,
    polycam,
    record3d,
    record3d_export,
    replica,
    scannet,
    seven_scenes,
    tartanair,
    tum,
)
from geogs.io.sources.formats.image_files import Place
from geogs.io.sources.layouts import Layout
from geogs.io.sources.reader import Reader

R = TypeVar("R")


def _whole(open_folder: Callable[[Path], R]) -> Callable[[Place], R]:
    """Opener for a layout with images of one camera."""
    return lambda place: open_folder(place.folder)


def _is_stray(folder: Path) -> bool:
    if not (folder / "rgb.mp4").is_file():
        return False
    from geogs.io.sources.formats.stray import is_stray  # loads FFmpeg

    return is_stray(folder)


def _open_stray(place: Place) -> Reader:
    from geogs.io.sources.formats.stray import StrayRecording

    return StrayRecording(place.folder)


LAYOUTS: tuple[Layout, ...] = (
    Layout(
        "TUM RGB-D", tum.is_tum, _whole(tum.open_tum), ("rgb",),
        ("groundtruth.txt", "depth.txt"), "rgb.txt with the times and names of its images",
        _whole(tum.open_posed_tum),
    ),
    Layout(
        "ICL-NUIM", icl_nuim.is_associated, _whole(icl_nuim.open_associated), ("rgb",),
        ("*.gt.freiburg",), "associations.txt with the names of its images",
        _whole(icl_nuim.open_posed_associated),
    ),
    Layout(
        "7-Scenes", seven_scenes.is_seven_scenes, _whole(seven_scenes.open_seven_scenes), (),
        ("frame-*.pose.txt", "seq-*/frame-*.pose.txt", "seq-*.zip"),
        "frame-000000.color.png with the images", _whole(seven_scenes.open_posed_seven_scenes),
    ),
    Layout(
        "Replica", replica.is_replica, _whole(replica.open_replica), (), ("traj.txt",),
        "results with frame000000.jpg and so on", _whole(replica.open_posed_replica),
    ),
    Layout(
        "ScanNet", scannet.is_scannet, _whole(scannet.open_scannet), ("color",), ("*.sens",),
        "color with the images (export them from the .sens first)",
        _whole(scannet.open_posed_scannet),
    ),
    Layout(
        "EuRoC or TUM-VI", None, asl.open_asl, asl.PICTURES,
        ("mav0", "cam0/data.csv", "data.csv"), "mav0/cam0/data with the images",
        asl.open_posed_asl,
    ),
    Layout(
        "KITTI odometry", None, kitti.open_kitti_odometry, kitti.ODOMETRY,
        ("times.txt",), "image_2 or image_0 with the images", kitti.open_posed_kitti_odometry,
    ),
    Layout(
        "KITTI raw", None, kitti_raw.open_kitti_raw, kitti_raw.RAW,
        ("oxts", "image_0*/timestamps.txt", "calib_cam_to_cam.txt"),
        "image_02/data with the images of a drive",
        kitti_raw.open_posed_kitti_raw,
    ),
    Layout(
        "ScanNet++", None, model_layouts.open_photographs,
        model_layouts.SCANNETPP, ("rgb.mkv", "iphone/rgb.mkv", "pose_intrinsic_imu.json"),
        "iphone/rgb with the images (extract them from rgb.mkv, or give that)",
        model_layouts.open_posed_photographs,
    ),
    Layout(
        "ETH3D", None, model_layouts.open_photographs, model_layouts.ETH3D,
        ("dslr_calibration_undistorted", "dslr_calibration_jpg"),
        "images/dslr_images_undistorted with the images", model_layouts.open_posed_photographs,
    ),
    Layout(
        "TartanAir", None, tartanair.open_tartanair, tartanair.PICTURES,
        ("pose_left.txt", "pose_lcam_*.txt"), "image_left or image_lcam_front with the images",
        tartanair.open_posed_tartanair,
    ),
    Layout(
        "ARKitScenes", arkitscenes.is_arkitscenes, arkitscenes.open_arkitscenes,
        arkitscenes.PICTURES, ("lowres_wide.traj", "lowres_wide_intrinsics", "lowres_wide"),
        "lowres_wide with the images, or lowres_wide_intrinsics,",
        arkitscenes.open_posed_arkitscenes,
    ),
    Layout(
        "Stray Scanner", _is_stray, _open_stray, (), ("odometry.csv", "camera_matrix.csv"),
        "rgb.mp4",
    ),
    Layout(
        "Polycam", polycam.polycam_folders, _whole(polycam.open_polycam), (),
        ("keyframes/cameras", "keyframes/corrected_cameras"), "keyframes/images",
    ),
    Layout(
        "Record3D", record3d.is_record3d, lambda p: record3d.Record3dRecording(p.folder), (),
        ("rgbd", "metadata"), "rgbd with the images beside the metadata",
    ),
    Layout(
        "Record3D", record3d_export.is_record3d_export,
        _whole(record3d_export.open_record3d_export), (), ("depth/*.exr",),
        "rgb with the pictures, or metadata.json with K, w, h and poses,",
    ),
)  # fmt: skip
"""Known layouts; the first that matches is used."""
WITH_MODEL = tuple(layout for layout in LAYOUTS if layout.name in ("ScanNet++", "ETH3D"))
"""Layouts whose poses are a COLMAP model."""
