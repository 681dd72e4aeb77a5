"""Depth from anywhere in a finished map: python examples/depth_of_a_view.py RESULT.

RESULT is the folder of ``geogs run``. Half-way between two keyframes, where no image was taken, the
depth is rendered from the disks and written as a picture.
"""

import sys
from pathlib import Path

import cv2
import numpy as np
import torch

import geogs
from geogs.geometry.lie import se3_exp, se3_inverse, se3_log


def main(folder: str, picture: Path = Path("depth.png")) -> float:
    """Writes the picture; returns the share of its pixels that have a depth."""
    result = geogs.load_result(folder)
    middle = len(result.keyframes) // 2
    before, after = (torch.from_numpy(result.keyframes[k].T_cw) for k in (middle - 1, middle))
    T_cw = se3_exp(0.5 * se3_log(after @ se3_inverse(before))) @ before
    depth = result.render(T_cw).depth
    known = depth > 0
    nearness = np.where(known, depth[known].min() / np.where(known, depth, 1), 0)
    shown = cv2.applyColorMap((255 * nearness).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    cv2.imwrite(str(picture), shown)
    return float(known.mean())


if __name__ == "__main__":
    main(sys.argv[1])
