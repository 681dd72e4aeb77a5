"""Start values for training splats with gsplat: arrays by the names its trainer uses."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from geogs.guard.atomic import atomic_file
from geogs.io.writers.ply_writer import SH_DEGREE_0, splat_scales
from geogs.types import MapSnapshot


def write_gsplat_start(path: Path, disks: MapSnapshot, colours: Float[np.ndarray, "n 3"]) -> None:
    """Write means, scales (logarithms), quats (w, x, y, z), opacities (logits) and sh0 as NPZ.

    ``colours`` are RGB from 0 to 1.
    """
    opacity = disks.opacity.cpu().double().numpy().clip(1e-6, 1 - 1e-6)
    arrays = {
        "means": disks.position.cpu().numpy(),
        "scales": np.log(splat_scales(disks)),
        "quats": disks.quaternion.cpu().numpy(),
        "opacities": np.log(opacity / (1 - opacity)),
        "sh0": (colours[:, None] - 0.5) / SH_DEGREE_0,
    }
    with atomic_file(path) as stream:
        np.savez_compressed(stream, **{k: v.astype(np.float32) for k, v in arrays.items()})
