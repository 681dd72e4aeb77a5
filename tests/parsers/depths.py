"""Depth of a sensor beside the images."""

import json
from pathlib import Path

import cv2
import numpy as np

import mutations
from geogs.config import InputConfig
from geogs.io.sources.sniff import open_source
from io_samples import gradient_image, write_image, write_video
from parsers.base import Parser, tiny_room
from posed_layouts import write_tum


def depths() -> dict[str, Parser]:
    """By what is damaged."""
    return {
        "depth-picture": Parser(replica, ("results/depth000000.png",), mutations.binary, all_of),
        "depth-scale": Parser(replica, ("cam_params.json",), mutations.json_text, all_of),
        "depth-list": Parser(tum, ("depth.txt",), mutations.text, all_of),
        "depth-unit": Parser(tum, ("camera.yaml",), mutations.yaml_text, all_of),
        "stray-camera": Parser(stray, ("camera_matrix.csv",), mutations.text, all_of),
    }


def all_of(folder: Path) -> object:
    """Every depth of the source, in metres."""
    config = InputConfig(intrinsics="50,50,31.5,23.5", depth="auto")
    found = [f.depth for f in open_source(folder, config)]
    return [None if d is None else d.metres() for d in found]


def write_depth(path: Path) -> None:
    """A picture of depth in 16 bits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    ramp = np.linspace(1000, 3000, 64 * 48).reshape(48, 64).astype(np.uint16)
    assert cv2.imwrite(str(path), ramp)


def replica(folder: Path) -> None:
    write_image(folder / "results/frame000000.jpg", gradient_image(0))
    write_depth(folder / "results/depth000000.png")
    camera = {"w": 64, "h": 48, "fx": 50, "fy": 50, "cx": 31.5, "cy": 23.5, "scale": 2000}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))


def tum(folder: Path) -> None:
    write_tum(tiny_room(), folder)
    write_depth(folder / "depth/0.png")
    (folder / "depth.txt").write_text("# time file\n0.0 depth/0.png\n0.04 depth/0.png\n")
    (folder / "camera.yaml").write_text("Camera.fx: 50.0\nRGBD.DepthMapFactor: 1000.0\n")


def stray(folder: Path) -> None:
    write_video(folder / "rgb.mp4", [gradient_image(i) for i in range(3)])
    write_depth(folder / "depth/000000.png")
    (folder / "camera_matrix.csv").write_text("50,0,31.5\n0,50,23.5\n0,0,1\n")
