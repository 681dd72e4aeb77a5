"""Scores of each depth in each cell of a keyframe, over all neighbours, weighted by visibility."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from geogs.depth.network.network_sizes import DepthNetworkOptions
from geogs.depth.network.plane_views import (
    PlaneViews,
    TriedDepths,
    cell_rays,
    sample_cells,
    see_planes,
)
from geogs.depth.network.rating import rate_planes
from geogs.depth.network.stereo_views import StereoViews

VOXEL, PIXEL, PLANE = 4, 3, 3
"""Numbers of inputs: of a plane in a cell beside correlations, of a cell, of a plane in a view."""
MOST_LOGIT = 10.0
"""Bound of the logarithm of a view's weight."""


class PlaneScorer(nn.Module):
    """Rates every plane of every cell in one neighbour: a score and its weight.

    Inputs of a small network are the correlations and the geometry: whether, how obliquely and how
    near the point is seen and how far it moves from plane to plane (after SimpleRecon's metadata).
    """

    def __init__(self, options: DepthNetworkOptions) -> None:
        super().__init__()
        width = options.metadata
        self.groups, self.matching = options.groups, options.matching
        self.voxel = _weight(width, options.groups + VOXEL)
        self.pixel = nn.Linear(PIXEL, width)
        self.plane = nn.Linear(PLANE, width, bias=False)
        self.hidden, self.hidden_bias = _weight(width, width), _bias(width)
        self.out, self.out_bias = _weight(2, width), _bias(2)

    def forward(
        self,
        own: Float[Tensor, "b c p"],
        theirs: Float[Tensor, "b c h w"],
        seen: PlaneViews,
        pixel: Float[Tensor, "b 3 p"],
        plane: Float[Tensor, "b d 3"],
    ) -> Float[Tensor, "b 2 d p"]:
        """Score, and logarithm of its weight; float32."""
        found = sample_cells(theirs, seen.cells)
        numbers = torch.stack([seen.seen.float(), seen.log_z, seen.angle, seen.log_step], 1)
        return rate_planes(own, found, numbers, pixel, plane, self._layers())

    def _layers(self) -> list[Tensor]:
        """Weights and biases of three layers; the first sees products of single channels."""
        each = self.matching // self.groups
        products = self.voxel[:, : self.groups].repeat_interleave(each, 1) / each
        first = (products, self.voxel[:, self.groups :], self.pixel.weight, self.plane.weight)
        weights = (torch.cat(first, 1), self.hidden, self.out)
        biases = (self.pixel.bias, self.hidden_bias[:, 0], self.out_bias[:, 0])
        return [x for layer in zip(weights, biases, strict=True) for x in layer]


class PlaneVolume(nn.Module):
    """Scores of all tried depths, combined over all neighbours."""

    def __init__(self, options: DepthNetworkOptions) -> None:
        super().__init__()
        self.scorer = PlaneScorer(options)

    def forward(
        self,
        own: Float[Tensor, "b c h w"],
        theirs: Float[Tensor, "b k c h w"],
        views: StereoViews,
        tried: TriedDepths,
    ) -> Float[Tensor, "b d1 h w"]:
        """A score for each depth, and the fraction of depths and neighbours that see a cell."""
        height, width = own.shape[-2:]
        rays = cell_rays(views.intrinsics, height, width, tried.cell)
        own, theirs = own.float().contiguous(), theirs.float().contiguous()
        pixel = torch.cat([rays[:, :2], _roughness(own)], 1)
        scores, weights, masks = [], [], []
        for k in range(theirs.shape[1]):
            T = views.T_nk[:, k].clone()
            T[:, :3, 3] /= views.typical[:, None]
            lens = views.other_intrinsics[:, k]
            seen = see_planes(rays, tried, T, lens, height, width)
            pose = _pose_numbers(T)[:, None].expand(-1, tried.label.shape[1], -1)
            plane = torch.cat([tried.label[..., None], pose], -1)
            rated = self.scorer(own.flatten(2), theirs[:, k], seen, pixel, plane)
            scores.append(rated[:, 0])
            weights.append(rated[:, 1])
            masks.append(seen.seen & views.valid[:, k, None, None])
        mask = torch.stack(masks, 1)
        volume = combined(torch.stack(scores, 1), torch.stack(weights, 1), mask)
        covered = mask.float().mean((1, 2))[:, None]
        return torch.cat([volume, covered], 1).unflatten(2, (height, width))


def combined(
    scores: Float[Tensor, "b k d p"],
    logits: Float[Tensor, "b k d p"],
    mask: Bool[Tensor, "b k d p"],
) -> Float[Tensor, "b d p"]:
    """Mean score of the neighbours that see a point, weighted by a softmax; 0 where none does."""
    weight = logits.clamp(-MOST_LOGIT, MOST_LOGIT).exp() * mask
    return (weight * scores).sum(1) / (weight.sum(1) + 1e-6)


def _roughness(features: Float[Tensor, "b c h w"]) -> Float[Tensor, "b 1 p"]:
    """Logarithm of the difference of features to those of the next cells."""
    across = torch.diff(features, dim=-1, append=features[..., -1:]).square().mean(1)
    down = torch.diff(features, dim=-2, append=features[..., -1:, :]).square().mean(1)
    return (across + down + 1e-3).log().flatten(1)[:, None]


def _pose_numbers(T: Float[Tensor, "b 4 4"]) -> Float[Tensor, "b 2"]:
    """Logarithm of the baseline, and the angle of rotation."""
    cosine = 0.5 * (T[:, :3, :3].diagonal(dim1=1, dim2=2).sum(1) - 1)
    angle = cosine.clamp(-1 + 1e-6, 1 - 1e-6).arccos()
    return torch.stack([(T[:, :3, 3].norm(dim=1) + 1e-3).log(), angle], 1)


def _weight(outputs: int, inputs: int) -> nn.Parameter:
    return nn.Parameter(torch.randn(outputs, inputs) * (2 / inputs) ** 0.5)


def _bias(outputs: int) -> nn.Parameter:
    return nn.Parameter(torch.zeros(outputs, 1))
