"""Files that say what is true of a synthetic sequence: its camera, its times, its poses."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from geogs.io.pose_files import FRAMES_PER_SECOND
from geogs.io.writers.atomic import atomic_file, write_text
from geogs.io.writers.trajectories import write_tum_trajectory
from geogs.types import Trajectory
from geogs_synth.camera.flaws import Flaws
from geogs_synth.camera.radial_camera import RadialCamera
from geogs_synth.motion.room_motions import Motion
from geogs_synth.sequence.location import Location


def write_camera(
    path: Path, location: Location, lens: RadialCamera, flaws: Flaws, moving: float
) -> None:
    """Writes the intrinsics, with the distortion, for programs; the rest is for evaluation."""
    camera = lens.camera
    intrinsics: dict[str, Any] = {
        "w": camera.width,
        "h": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "scale": location.depth_scale,
    }
    if lens.is_distorted:
        intrinsics["distortion"] = [lens.k1, lens.k2, 0.0, 0.0]
    parameters: dict[str, Any] = {
        "camera": intrinsics,
        "convention": "OpenCV axes, pixel centres at integer coordinates, depth = z",
        "scene": location.name,
    }
    if flaws != Flaws() or moving or location.kind != "handheld":
        parameters["motion"] = location.kind
        parameters["fps"] = location.motion.rate
        parameters["readout"] = flaws.readout
        parameters["flaws"] = asdict(flaws)
        parameters["moving"] = moving
    write_text(path, json.dumps(parameters, indent=1) + "\n")


def write_trajectory(folder: Path, motion: Motion, frames: int, image_format: str) -> None:
    """Writes ``traj.txt``; where that does not tell the times, lists of TUM besides."""
    times = np.arange(frames) / motion.rate
    T_wc = motion.path(times)
    with atomic_file(folder / "traj.txt") as stream:
        np.savetxt(stream, T_wc.reshape(-1, 16), fmt="%.9f")
    # A list of an earlier sequence in this folder would be believed.
    if motion.rate != FRAMES_PER_SECOND or (folder / "rgb.txt").exists():
        names = (f"results/frame{index:06d}.{image_format}" for index in range(frames))
        lines = (f"{time:.6f} {name}\n" for time, name in zip(times, names, strict=True))
        write_text(folder / "rgb.txt", "".join(lines))
        poses = Trajectory(np.round(times, 6), T_wc, np.ones(frames, bool))
        write_tum_trajectory(folder / "groundtruth.txt", poses)
