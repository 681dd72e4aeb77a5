"""Dense depths of keyframes as arrays of a table."""

import torch

from geogs.depth.depth_view import DenseDepth
from geogs.world.arrays import ArrayTable
from geogs.world.map import SearchedDepth


def put_depth(arrays: ArrayTable, id: int, depth: DenseDepth, scale: float) -> SearchedDepth:
    """Write the depth of a keyframe that has a scale now.

    Raises:
        OutputError: the disk is full, or cannot be written.
    """
    maps = depth.arrays()
    arrays.put("depth", id, maps.depth)
    arrays.put("confidence", id, maps.confidence)
    # Nobody measures with the normals.
    normal = None if depth.normal is None else depth.normal.half()
    for name, values in (("depth normal", normal), ("sky", depth.sky)):
        if values is None:
            arrays.drop(name, id)
        else:
            arrays.put(name, id, values.cpu().numpy())
    return SearchedDepth(depth.typical, scale)


def get_depth(
    arrays: ArrayTable, id: int, stored: SearchedDepth, scale: float, device: torch.device
) -> DenseDepth:
    """Read the depth of a keyframe at another scale of it."""
    depth, confidence = (torch.from_numpy(arrays.load(n, id)) for n in ("depth", "confidence"))
    if scale != stored.scale:
        depth = depth * (scale / stored.scale)
    normal, sky = arrays.get("depth normal", id), arrays.get("sky", id)
    return DenseDepth(
        depth.to(device), confidence.to(device), torch.tensor(stored.typical_at(scale)),
        normal=None if normal is None else torch.from_numpy(normal).float().to(device),
        sky=None if sky is None else torch.from_numpy(sky).to(device),
    )  # fmt: skip
