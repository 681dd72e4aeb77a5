"""What is known of a keyframe, pixel by pixel, as pictures."""

from typing import Literal, get_args

import numpy as np
from jaxtyping import Float, UInt8

from geogs.evaluation.pages.run_pictures import normal_colours
from geogs.types import RenderedKeyframe

Layer = Literal["image", "depth", "normal", "confidence"]
LAYERS: tuple[Layer, ...] = get_args(Layer)


def layer_picture(keyframe: RenderedKeyframe, layer: Layer) -> UInt8[np.ndarray, "h w 3"]:
    """A picture of one layer, RGB; black where nothing is known.

    Depth goes from blue, near, to red, far (1st to 99th percentile); normals show x, y, z of the
    camera as red, green, blue, what faces the camera being bright blue; confidence goes to white.
    """
    match layer:
        case "image":
            if keyframe.image is None:
                return np.zeros((*keyframe.depth.shape, 3), np.uint8)
            return keyframe.image
        case "depth":
            return depth_picture(keyframe.depth.cpu().numpy())
        case "normal":
            return normal_colours(keyframe.normal.cpu().numpy(), background=0)
        case "confidence":
            weight = keyframe.weight.cpu().numpy()
            return _bytes(np.repeat(weight[..., None], 3, -1))


def depth_picture(depth: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Depth in colours; black where it is 0 or not finite."""
    from matplotlib import colormaps

    known = np.isfinite(depth) & (depth > 0)
    if not known.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    low, high = np.quantile(depth[known], [0.01, 0.99])
    fraction = (np.where(known, depth, low) - low) / max(high - low, 1e-12)
    return _bytes(np.where(known[..., None], colormaps["turbo"](fraction.clip(0, 1))[..., :3], 0))


def _bytes(values: Float[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    return (255 * values.clip(0, 1)).round().astype(np.uint8)
