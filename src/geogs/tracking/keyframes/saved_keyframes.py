"""Fixed keyframes of a saved map, for relocalisation."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.device_choice import grid_fields
from geogs.errors import InputError
from geogs.types import RenderedKeyframe
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet
from geogs.world.segments import TrackState, VideoSegment

DEVIATION = 0.01
"""Relative deviation of a map's rendered depth, where its confidence is 1."""
ONE_SURFACE = 1.1
"""Largest ratio of the depths of four neighbouring pixels on one surface."""


def add_saved_keyframes(segment: VideoSegment, saved: Sequence[RenderedKeyframe]) -> list[int]:
    """Begin a segment in the gauge of a saved map with fixed keyframes; return their ids.

    The camera is lost there until a frame is recognised at one of them.

    Raises:
        InputError: a keyframe has no image, or one of another camera.
    """
    ids = [_add(segment.keyframes, k, n - len(saved)) for n, k in enumerate(saved)]
    segment.fixed[:], segment.final[:] = ids, ids
    segment.status.state = TrackState.LOST
    return ids


def _add(keyframes: KeyframeSet, saved: RenderedKeyframe, frame_index: int) -> int:
    """Add a keyframe with the depth of a saved map; return its id."""
    grid, encode = keyframes.grid, keyframes.table.encode
    if saved.image is None:
        raise InputError("The map was saved without the images of its keyframes.")
    height, width = saved.image.shape[:2]
    if (width, height) != (grid.camera.width, grid.camera.height):
        raise InputError(
            f"The images of the map are {width} x {height} pixels, those of the video "
            f"{grid.camera.width} x {grid.camera.height}; both have to be of one camera."
        )
    encoded = None if encode is None else encode(saved.image)
    keyframe = keyframes.add(frame_index, saved.timestamp, saved.image, encoded, saved.T_cw)
    inverse_depth, confidence = depth_on_grid(grid, saved)
    information = confidence / (DEVIATION * inverse_depth.clamp(min=1e-6)).square()
    information = information * (confidence > 0)
    filled = grid_fields(grid).fill(inverse_depth[None], information[None])[0]
    keyframe.inverse_depth, keyframe.information = filled.clone(), information
    return keyframe.id


def depth_on_grid(
    grid: SampleGrid, saved: RenderedKeyframe
) -> tuple[Float[Tensor, "p"], Float[Tensor, "p"]]:
    """Return inverse depth of the cells and its confidence; both 0 where unknown.

    Inverse depth is linear over the image of a plane, so it is interpolated; not across an edge.
    """
    height, width = saved.depth.shape
    size = grid.pixels.new_tensor([width, height])
    own = grid.pixels.new_tensor([grid.camera.width, grid.camera.height])
    at = (grid.pixels + 0.5) * size / own - 0.5
    low = at.floor().clamp(min=0).minimum(size - 2)
    fraction = (at - low).clamp(0, 1)
    x, y = low.long().unbind(-1)
    depth, weight = saved.depth.to(grid.device), saved.weight.to(grid.device)
    corners = [(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)]
    z = torch.stack([depth[v, u] for u, v in corners], -1)
    trust = torch.stack([weight[v, u] for u, v in corners], -1).amin(-1)
    known = (z > 0).all(-1) & (z.amax(-1) <= ONE_SURFACE * z.amin(-1))
    (a, b), (c, d) = (1 - fraction).unbind(-1), fraction.unbind(-1)
    part = torch.stack([a * b, c * b, a * d, c * d], -1)
    inverse = (part / z.clamp(min=1e-9)).sum(-1)
    return torch.where(known, inverse, 0.0).float(), torch.where(known, trust, 0.0).float()
