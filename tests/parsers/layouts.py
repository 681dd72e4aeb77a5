"""Data sets as they lie on disk: lists, times, cameras and true poses."""

from collections.abc import Callable
from pathlib import Path

import mutations
from data_set_layouts import LAYOUTS
from geogs.evaluation.true_scene import read_true_scene
from geogs.io.sources.sniff import open_source
from parsers.base import Damage, Parser


def layouts() -> dict[str, Parser]:
    """By the data sets, with the files of theirs that other data sets have not."""
    files: dict[str, tuple[str, tuple[str, ...], Damage]] = {
        "kitti-odometry": (
            "dataset/sequences/07",
            ("dataset/sequences/07/calib.txt", "dataset/sequences/07/times.txt",
             "dataset/poses/07.txt"), mutations.text,
        ),
        "kitti-raw": (
            "2011_09_26/2011_09_26_drive_0001_sync",
            ("2011_09_26/calib_cam_to_cam.txt", "2011_09_26/calib_imu_to_velo.txt",
             "2011_09_26/2011_09_26_drive_0001_sync/oxts/data/0000000003.txt",
             "2011_09_26/2011_09_26_drive_0001_sync/oxts/timestamps.txt",
             "2011_09_26/2011_09_26_drive_0001_sync/image_02/timestamps.txt"), mutations.text,
        ),
        "euroc": (
            "MH_01_easy",
            ("MH_01_easy/mav0/cam0/data.csv",
             "MH_01_easy/mav0/state_groundtruth_estimate0/data.csv"), mutations.text,
        ),
        "tum-vi": (
            "dataset-room1_512_16", ("dataset-room1_512_16/dso/camchain.yaml",),
            mutations.yaml_text,
        ),
        "icl-nuim": (
            "living_room_traj0_frei_png",
            ("living_room_traj0_frei_png/associations.txt",
             "living_room_traj0_frei_png/livingRoom0.gt.freiburg"), mutations.text,
        ),
        "tartanair": (
            "abandonedfactory/Easy/P001", ("abandonedfactory/Easy/P001/pose_left.txt",),
            mutations.text,
        ),
        "arkitscenes": (
            "Training/41069021",
            ("Training/41069021/lowres_wide.traj",
             "Training/41069021/lowres_wide_intrinsics/41069021_305.377.pincam"), mutations.text,
        ),
        "scannetpp-phone": (
            "0a5c013435/iphone", ("0a5c013435/iphone/colmap/images.txt",), mutations.text
        ),
    }  # fmt: skip

    def use(below: str) -> Callable[[Path], object]:
        def read(folder: Path) -> object:
            return list(open_source(folder / below)), read_true_scene(folder / below)

        return read

    return {
        f"layout-{name}": Parser(LAYOUTS[name], damaged, damage, use(below))
        for name, (below, damaged, damage) in files.items()
    }
