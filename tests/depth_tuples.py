"""Tiny rooms, a tiny depth network, and a course of them."""

import torch

from geogs.depth.network.network_sizes import DepthNetworkOptions
from geogs.depth.network.stereo_views import StereoViews
from geogs_synth.clips.room_options import RoomOptions
from geogs_train.depth.depth_options import DepthTraining, PoolOptions, TupleOptions

NETWORK = DepthNetworkOptions(
    planes=12,
    groups=4,
    matching=8,
    encoder=(8, 8, 8),
    context=(8, 8, 8, 8, 8),
    volume=(16, 16, 16, 16),
    metadata=8,
    decoder=8,
)
TRAINING = DepthTraining(
    steps=6,
    batch=2,
    small_batch=2,
    rooms=RoomOptions(
        width=64,
        height=48,
        views=5,
        textures=6,
        texture_size=64,
        candidates=8,
        least_density=0.05,
        most_density=0.2,
        sway=0.25,
    ),
    small_width=48,
    small_height=32,
    pool=PoolOptions(plans=2, rooms=1, refresh=1),
    tuples=TupleOptions(most_neighbours=4),
    network=NETWORK,
    warmup=2,
)


def random_views(b: int, k: int, h: int, w: int, seed: int = 0) -> StereoViews:
    """Noise seen by cameras that moved a little."""
    rng = torch.Generator().manual_seed(seed)
    T = torch.eye(4).repeat(b, k, 1, 1)
    T[..., :3, 3] = 0.1 * torch.randn(b, k, 3, generator=rng)
    lens = torch.tensor([0.9 * w, 0.95 * w, 0.5 * w - 1, 0.5 * h + 1])
    return StereoViews(
        torch.rand(b, 3, h, w, generator=rng),
        torch.rand(b, k, 3, h, w, generator=rng),
        lens.repeat(b, 1),
        lens.repeat(b, k, 1),
        T,
        torch.ones(b, k, dtype=torch.bool),
        torch.full((b,), 0.5),
        torch.full((b,), 5.0),
        torch.full((b,), 1.5),
    )
