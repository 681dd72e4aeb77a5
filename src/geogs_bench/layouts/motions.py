"""Sequences of ``geogs synth`` as cells of the matrix of motions, scored by their trajectory."""

from pathlib import Path

from geogs_bench.layouts.places import folders_like
from geogs_bench.scene import Scene, TruePoses, Truth


def find_motions(root: Path) -> list[Scene]:
    """Every sequence below ``root``, or ``root`` itself if it is one."""
    return [
        Scene(folder.resolve().name, folder, Truth(poses=TruePoses(folder)), kind="motion")
        for folder in folders_like(root, _is_sequence)
    ]


def _is_sequence(folder: Path) -> bool:
    return (folder / "cam_params.json").is_file() and (folder / "traj.txt").is_file()
