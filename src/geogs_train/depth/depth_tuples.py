"""Samples from a pool of clips: a keyframe and neighbours, with errors like a tracker's."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.depth.network.search_range import RATIO
from geogs.depth.network.stereo_views import StereoViews
from geogs.geometry.lie import se3_exp, se3_inverse
from geogs_synth.draw import Draw
from geogs_train.depth.clip_pool import StoredClips
from geogs_train.depth.depth_options import TupleOptions

MOST_TURN = math.radians(40)
"""Largest angle between viewing directions of a good neighbour."""


@dataclass(frozen=True)
class DepthBatch:
    """Samples with their truth."""

    views: StereoViews
    """The network's input, with errors; lengths in metres."""
    depth: Float[Tensor, "b h w"]
    """Depth of the keyframe, metres."""
    normal: Float[Tensor, "b 3 h w"]
    """Camera frame."""
    place: Int[Tensor, "b 2"]
    """Clip in the pool, view in the clip."""
    progress: float = 1.0
    """Finished fraction of the run."""


def draw_tuples(
    clips: StoredClips, count: int, neighbours: int, options: TupleOptions, draw: Draw
) -> DepthBatch:
    """Draw and disturb ``count`` keyframes with ``neighbours`` each."""
    total, views = clips.depth.shape[:2]
    clip = draw.integers(total, count)
    view = draw.integers(views, count)
    others = choose_neighbours(clips, clip, view, neighbours, options, draw)
    T = clips.T_cw[clip]
    own = T[torch.arange(count, device=draw.device), view]
    relative = T.gather(1, others[..., None, None].expand(-1, -1, 4, 4)) @ se3_inverse(own)[:, None]
    # Some neighbours show another room, some are missing.
    strange = draw.chance(options.dud, count, neighbours)
    shown = torch.where(strange, draw.integers(total, count, neighbours), clip[:, None])
    valid = ~draw.chance(options.missing, count, neighbours)
    valid[:, 0] = True
    low, typical, high = clips.quantiles[clip, view].unbind(-1)
    near, far, typical = known_range(low, typical, high, options, draw)
    relative = disturbed_poses(relative, options, draw)
    lens = clips.intrinsics[clip]
    wrong = draw.chance(options.disturbed, count) * options.focal
    factor = 1 + wrong * (2 * draw.uniform(0, 1, count) - 1)
    lens = torch.cat([lens[:, :2] * factor[:, None], lens[:, 2:]], 1)
    images = torch.cat([clips.images[clip, view][:, None], clips.images[shown, others]], 1)
    images = relit(images.float() / 255, options.photometric, draw)
    lenses = lens[:, None].expand(-1, neighbours, -1)
    known = StereoViews(
        images[:, 0], images[:, 1:], lens, lenses, relative, valid, near, far, typical
    )
    place = torch.stack([clip, view], 1)
    return DepthBatch(known, clips.depth[clip, view], clips.normal[clip, view].float(), place)


def choose_neighbours(
    clips: StoredClips,
    clip: Int[Tensor, "b"],
    view: Int[Tensor, "b"],
    count: int,
    options: TupleOptions,
    draw: Draw,
) -> Int[Tensor, "b k"]:
    """Choose views of the same clips: good ones first, in random order, then the nearly good."""
    T = clips.T_cw[clip]
    rows = torch.arange(len(clip), device=clip.device)
    centre = -(T[..., :3, :3].mT @ T[..., :3, 3:])[..., 0]
    baseline = (centre - centre[rows, view][:, None]).norm(dim=-1)
    ratio = (baseline / clips.quantiles[clip, view, 1][:, None]).clamp_min(1e-9)
    cosine = (T[..., 2, :3] * T[rows, view][:, None, 2, :3]).sum(-1)
    short = (options.least_baseline / ratio).log().clamp_min(0)
    long = (ratio / options.most_baseline).log().clamp_min(0)
    turned = (cosine.clamp(-1, 1).arccos() / MOST_TURN - 1).clamp_min(0)
    misfit = short + long + turned + 0.3 * draw.uniform(0, 1, *ratio.shape)
    misfit[rows, view] = torch.inf
    if count >= misfit.shape[1]:
        raise ValueError(f"A clip of {misfit.shape[1]} views has no {count} neighbours.")
    return misfit.argsort(1)[:, :count]


def known_range(
    low: Float[Tensor, "b"],
    typical: Float[Tensor, "b"],
    high: Float[Tensor, "b"],
    options: TupleOptions,
    draw: Draw,
) -> tuple[Float[Tensor, "b"], Float[Tensor, "b"], Float[Tensor, "b"]]:
    """Nearest, farthest and median depth with a tracker's errors; at worst they leave out about
    half the depths beyond the quantiles."""
    n = len(low)
    near = 0.5 * low / _log_uniform(draw, options.range_error, n)
    far = 2.0 * high * _log_uniform(draw, options.range_error, n)
    widen = (RATIO[0] / (far / near)).clamp_min(1).sqrt()
    narrow = ((far / near) / RATIO[1]).clamp_min(1)
    near, far = near / widen * narrow.sqrt(), far * widen / narrow.sqrt()
    return near, far, typical * _log_uniform(draw, options.typical_error, n)


def disturbed_poses(
    T: Float[Tensor, "b k 4 4"], options: TupleOptions, draw: Draw
) -> Float[Tensor, "b k 4 4"]:
    """Add a tracker's errors to the poses of a fraction of the samples."""
    b, k = T.shape[:2]
    wrong = draw.chance(options.disturbed, b, 1, 1).float()
    degrees = _log_uniform(draw, options.rotation, b, 1, 1)
    rotation = torch.deg2rad(degrees) * draw.normal(1.0, b, k, 3)
    baseline = T[..., :3, 3].norm(dim=-1, keepdim=True)
    shift = _log_uniform(draw, options.translation, b, 1, 1) * baseline * draw.normal(1.0, b, k, 3)
    # About the neighbour's own centre: a rotation alone does not change the baseline.
    return se3_exp(wrong * torch.cat([shift, rotation], -1)).to(T) @ T


def relit(
    images: Float[Tensor, "b v 3 h w"], strength: float, draw: Draw
) -> Float[Tensor, "b v 3 h w"]:
    """Change exposure, white balance and tone of each image a little, at random, and add noise."""
    b, v = images.shape[:2]

    def vary(deviation: float, *channels: int) -> Float[Tensor, "b v c 1 1"]:
        numbers = deviation * strength * draw.normal(1.0, b, v, *channels)
        return numbers.exp().reshape(b, v, -1, 1, 1)

    bright = images.clamp_min(1e-3) ** vary(0.15, 1) * vary(0.15, 1) * vary(0.04, 3)
    deviation = 0.02 * strength * draw.uniform(0, 1, b, v, 1, 1, 1).square()
    return (bright + deviation * draw.normal(1.0, *images.shape)).clamp(0, 1)


def _log_uniform(draw: Draw, bounds: tuple[float, ...], *shape: int) -> Float[Tensor, "..."]:
    """Like ``Draw.log_uniform``, but rounded as in the training of the shipped networks."""
    low, high = (math.log(x) for x in bounds)
    return (low + (high - low) * draw.uniform(0, 1, *shape)).exp()


def has_truth(batch: DepthBatch) -> Bool[Tensor, "b h w"]:
    """Mask of the pixels with a depth in the search range, or nearly."""
    near, far = (x[:, None, None] for x in (batch.views.near, batch.views.far))
    known = batch.depth.isfinite() & (batch.views.typical > 0)[:, None, None]
    return known & (batch.depth > 0.5 * near) & (batch.depth < 2 * far)
