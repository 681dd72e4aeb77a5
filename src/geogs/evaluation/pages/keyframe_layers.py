"""What is known of a keyframe, pixel by pixel, as pictures."""

from typing import Literal, get_args

import numpy as np
from jaxtyping import UInt8

from geogs.evaluation.pages.run_pictures import depth_colours, normal_colours
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
            depth = keyframe.depth.cpu().numpy()
            known = depth[np.isfinite(depth) & (depth > 0)]
            low, high = np.quantile(known, [0.01, 0.99]) if len(known) else (0.0, 1.0)
            return depth_colours(depth, float(low), float(high), background=0)
        case "normal":
            return normal_colours(keyframe.normal.cpu().numpy(), background=0)
        case "confidence":
            weight = keyframe.weight.cpu().numpy()
            grey = (255 * weight.clip(0, 1)).round().astype(np.uint8)
            return np.repeat(grey[..., None], 3, -1)
