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
from geogs.depth.network.layers import Block, Residual, doubled
from geogs.depth.network.network_sizes import DepthNetworkOptions
from geogs.depth.network.plane_views import TriedDepths, cell_rays, log_planes
from geogs.depth.network.stereo_views import DepthPrediction, StereoViews
from geogs.depth.network.volume import PlaneVolume
from geogs.networks.tensor_files import load_trained

MULTIPLE = 32
"""Images are padded to a multiple of this, pixels."""


class MatchingEncoder(nn.Module):
    """Matching features of unit scale at 1/4 and 1/2, the same network for all views."""

    def __init__(self, options: DepthNetworkOptions) -> None:
        super().__init__()
        half, quarter, eighth = options.encoder
        self.at_half = nn.Sequential(Block(3, half, 6), Residual(half))
        self.at_quarter = nn.Sequential(
            Block(half, quarter, 4), Residual(quarter), Residual(quarter)
        )
        self.at_eighth = nn.Sequential(Block(quarter, eighth, 4), Residual(eighth))
        self.back = nn.Conv2d(eighth, quarter, 1)
        self.out = nn.Sequential(Block(quarter, quarter), nn.Conv2d(quarter, options.matching, 1))
        self.back_to_half = nn.Conv2d(quarter, half, 1)
        self.fine = nn.Sequential(Block(half, half), nn.Conv2d(half, options.fine_matching, 1))

    def forward(
        self, images: Float[Tensor, "n 3 h w"]
    ) -> tuple[Float[Tensor, "n c h4 w4"], Float[Tensor, "n f h2 w2"]]:
        half = self.at_half(images)
        quarter = self.at_quarter(half)
        joined = quarter + doubled(self.back(self.at_eighth(quarter)))
        fine = self.fine(half + doubled(self.back_to_half(joined)))
        return _of_one_length(self.out(joined)), _of_one_length(fine)


class ContextEncoder(nn.Module):
    """Features of the keyframe and its rays at 1/2, 1/4, ..."""

    def __init__(self, options: DepthNetworkOptions) -> None:
        super().__init__()
        inputs = 5
        stages = []
        for level, channels in enumerate(options.context):
            down = Block(inputs, channels, 4 if level else 6)
            stages.append(nn.Sequential(down, Residual(channels)))
            inputs = channels
        self.stages = nn.ModuleList(stages)

    def forward(
        self, images: Float[Tensor, "n 3 h w"], intrinsics: Float[Tensor, "n 4"]
    ) -> list[Tensor]:
        height, width = images.shape[-2:]
        rays = cell_rays(intrinsics, height, width, 1)[:, :2].unflatten(2, (height, width))
        x = torch.cat([images, rays], 1)
        found = []
        for stage in self.stages:
            x = stage(x)
            found.append(x)
        return found


def normalised(images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
    """Images minus the mean of each colour, divided by the contrast of all."""
    centred = images - images.mean((2, 3), keepdim=True)
    return centred / (centred.square().mean((1, 2, 3), keepdim=True).sqrt() + 0.02)


def _of_one_length(features: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
    return features.shape[1] ** 0.5 * functional.normalize(features.float(), dim=1)


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
