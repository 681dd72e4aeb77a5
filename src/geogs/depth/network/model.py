"""The depth network: a keyframe and posed neighbours to depth, deviation, normals, confidence.

A plane sweep with learned features whose scores become the channels of a 2D network (after
SimpleRecon), with weights for each neighbour's visibility (after CVA-MVSNet); depth around the
likeliest plane; a second search at 1/2 near that depth and on either side of edges (as in the
cascades of multi-view stereo), one of whose depths is chosen; and a deviation and normals with a
concentration trained by their likelihoods. It sees lengths relative to the typical depth only.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from geogs.depth.network.decoder import DepthReadout, VolumeNetwork
from geogs.depth.network.depth_calibration import DepthCalibration
from geogs.depth.network.encoders import ContextEncoder, MatchingEncoder, normalised
from geogs.depth.network.network_sizes import DepthNetworkOptions
from geogs.depth.network.plane_views import TriedDepths, log_planes
from geogs.depth.network.stereo_views import DepthPrediction, StereoViews
from geogs.depth.network.volume import PlaneVolume
from geogs.networks.tensor_files import load_trained

MULTIPLE = 32
"""Images are padded to a multiple of this, pixels."""


class DepthNetwork(nn.Module):
    """Encoders, plane sweep, network over the planes, read-out."""

    def __init__(
        self,
        options: DepthNetworkOptions | None = None,
        calibration: DepthCalibration | None = None,
    ) -> None:
        super().__init__()
        self.options = options or DepthNetworkOptions()
        self.calibration = calibration or DepthCalibration()
        """Calibration of deviations and confidences; not trained with the network."""
        self.matching = MatchingEncoder(self.options)
        self.context = ContextEncoder(self.options)
        self.volume = PlaneVolume(self.options)
        self.body = VolumeNetwork(self.options)
        self.readout = DepthReadout(self.options)

    def forward(self, views: StereoViews) -> DepthPrediction:
        """Depth of the keyframes; networks in bfloat16 on a GPU, geometry in float32."""
        height, width = views.image.shape[-2:]
        images = torch.cat([views.image[:, None], views.others], 1)
        images = _padded(normalised(images.flatten(0, 1)))
        device = views.image.device.type
        with torch.autocast(device, torch.bfloat16, enabled=device == "cuda"):
            coarse, fine = (x.unflatten(0, (len(views.image), -1)) for x in self.matching(images))
            images = images.unflatten(0, (len(views.image), -1))
            context = self.context(images[:, 0], views.intrinsics)
            with torch.autocast(device, enabled=False):
                planes = log_planes(
                    views.near / views.typical, views.far / views.typical, self.options.planes
                )
                tried = TriedDepths.planes(planes)
                volume = self.volume(coarse[:, 0], coarse[:, 1:], views, tried)
            body = self.body(volume, context[1:])
            found = self.readout(body, context[0], fine, planes, views, volume[:, :-1])
        return _cropped(found, height, width)


def load_depth_network(path: Path) -> DepthNetwork:
    """Load the network of a weights file; raises InputError if that is missing or another's."""

    def build(about: dict[str, Any]) -> DepthNetwork:
        calibration = DepthCalibration(**about["calibration"])
        return DepthNetwork(DepthNetworkOptions(**about["options"]), calibration)

    return load_trained(path, "depth", build)


def _padded(images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h2 w2"]:
    height, width = images.shape[-2:]
    pad = (0, -width % MULTIPLE, 0, -height % MULTIPLE)
    return functional.pad(images, pad, mode="replicate") if any(pad) else images


def _cropped(found: DepthPrediction, height: int, width: int) -> DepthPrediction:
    """Crop maps to the image; those at 1/2 and 1/4 keep their padding."""
    if found.log_depth.shape[-2:] == (height, width):
        return found
    names = ("log_depth", "log_scale", "outlier", "normal", "concentration")
    return replace(found, **{n: getattr(found, n)[..., :height, :width] for n in names})
