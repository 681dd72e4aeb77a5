"""Files that describe a camera."""

import json
from collections.abc import Callable
from pathlib import Path

import mutations
from parsers.base import Damage, Parser, written


def calibrations() -> dict[str, Parser]:
    """By the formats that say what a camera is like."""
    from geogs.io.sources.calibration_files import read_calibration
    from geogs.io.sources.undistort import Rectifier
    from geogs.io.writers.intrinsics_file import read_camera

    own = {
        "width": 64, "height": 48, "fx": 50.0, "fy": 50.0, "cx": 31.5, "cy": 23.5,
        "source": {"width": 64, "height": 48, "fx": 50.0, "fy": 50.0, "cx": 31.5, "cy": 23.5,
                   "distortion": [0.01, 0.0, 0.0, 0.0], "is_guess": False},
    }  # fmt: skip
    nerf = {"camera_model": "OPENCV", "fl_x": 50.0, "fl_y": 50.0, "cx": 32, "cy": 24, "w": 64,
            "h": 48, "k1": 0.01}  # fmt: skip
    kalibr = (
        "resolution: [64, 48]\nintrinsics: [50.0, 50.0, 31.5, 23.5]\n"
        "distortion_model: radtan\ndistortion_coefficients: [0.01, 0.0, 0.0, 0.0]\n"
    )
    ros = (
        "image_width: 64\nimage_height: 48\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        "  data: [50.0, 0.0, 31.5, 0.0, 50.0, 23.5, 0.0, 0.0, 1.0]\n"
        "distortion_model: plumb_bob\n"
        "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0.01, 0.0, 0.0, 0.0, 0.0]\n"
    )
    fisheye = {"width": 64, "height": 48, "fx": 30.0, "fy": 30.0, "cx": 31.5, "cy": 23.5,
               "lens": "fisheye", "distortion": [0.01, 0.0, 0.0, 0.0]}  # fmt: skip
    texts: dict[str, tuple[str, str, Damage]] = {
        "fisheye-json": ("c.json", json.dumps(fisheye), mutations.json_text),
        "fisheye-kalibr": ("c.yaml", kalibr.replace("radtan", "equidistant"), mutations.yaml_text),
        "fisheye-colmap": (
            "cameras.txt", "1 OPENCV_FISHEYE 64 48 30 30 32 24 0.01 0 0 0\n", mutations.text
        ),
        "fisheye-numbers": ("calib.txt", "fisheye 30 30 31.5 23.5 0.01 0 0 0\n", mutations.text),
        "calibration-json": ("c.json", json.dumps(own), mutations.json_text),
        "calibration-nerfstudio": ("c.json", json.dumps(nerf), mutations.json_text),
        "calibration-kalibr": ("c.yaml", kalibr, mutations.yaml_text),
        "calibration-ros": ("c.yml", ros, mutations.yaml_text),
        "calibration-colmap": (
            "cameras.txt", "# one\n1 OPENCV 64 48 50 50 32 24 0.01 0 0 0\n", mutations.text
        ),
        "calibration-kitti": (
            "calib.txt", "P0: 50 0 31.5 0 0 50 23.5 0 0 0 1 0\nTr: 1 0 0\n", mutations.text
        ),
        "calibration-pincam": ("a.pincam", "64 48 50 50 31.5 23.5\n", mutations.text),
        "calibration-scannetpp": (
            "pose_intrinsic_imu.json",
            json.dumps({"frame_000000": {"intrinsic": [[50, 0, 31.5], [0, 50, 23.5], [0, 0, 1]]}}),
            mutations.json_text,
        ),
        "calibration-record3d": (
            "metadata", json.dumps({"w": 64, "h": 48, "K": [50, 0, 0, 0, 50, 0, 31.5, 23.5, 1]}),
            mutations.json_text,
        ),
        "calibration-numbers": ("calib.txt", "50 50 31.5 23.5 0.01 0 0 0\n", mutations.text),
        "calibration-matrix": ("k.txt", "50 0 31.5\n0 50 23.5\n0 0 1\n", mutations.text),
    }  # fmt: skip

    def use(name: str) -> Callable[[Path], object]:
        return lambda folder: Rectifier(read_calibration(folder / name).fit(64, 48), 32).camera

    found = {
        key: Parser(written(name, content), (name,), damage, use(name))
        for key, (name, content, damage) in texts.items()
    }
    found["camera-of-a-result"] = Parser(
        written("intrinsics.json", json.dumps(own)), ("intrinsics.json",), mutations.json_text,
        lambda folder: read_camera(folder / "intrinsics.json").rays(),
    )  # fmt: skip
    return found
