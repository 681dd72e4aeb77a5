"""Random renderings and keyframes for the single-view losses."""

import numpy as np
import torch

from geogs.config import LossAblation, LossConfig
from geogs.geometry.camera import Camera
from geogs.losses.single_view import OUTSIDE, ViewConstants

CAMERA = Camera(11.0, 12.0, 5.2, 4.1, 12, 10)


def random_view(seed: int, camera: Camera = CAMERA) -> tuple[list[torch.Tensor], ViewConstants]:
    """Smooth random maps in float64 and a keyframe with random priors, some unknown, and a mask."""
    rng = np.random.default_rng(seed)
    h, w = camera.height, camera.width

    def uniform(*shape: int) -> torch.Tensor:
        return torch.from_numpy(rng.random(shape))

    rows, columns = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    depth = 2 + 0.2 * torch.sin(columns / 3.0) + 0.1 * torch.cos(rows / 2.0) + 0.05 * uniform(h, w)
    normal = 0.3 * (uniform(h, w, 3) - 0.5) - torch.tensor([0.0, 0.0, 0.8])
    maps = [depth.double(), normal.double(), 0.3 + 0.7 * uniform(h, w), 0.1 * uniform(h, w)]
    prior = maps[0] * (1 + 0.1 * (uniform(h, w) - 0.5))
    prior[uniform(h, w) < 0.1] = 0
    prior[: h // 3, w // 2 :] = OUTSIDE
    towards = torch.nn.functional.normalize(normal + 0.2 * uniform(h, w, 3), dim=-1)
    towards[uniform(h, w) < 0.1] = 0
    image = (255 * rng.random((h, w, 3))).astype(np.uint8)
    return maps, ViewConstants.prepare(image, camera, prior, uniform(h, w), towards)


ALL_TERMS = LossConfig(
    normal_weight=0.1, smoothness_weight=0.05, ablation=LossAblation(smoothness_rewards_edges=True)
)
