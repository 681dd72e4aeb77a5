"""Scores of each depth in each cell of a keyframe, over all neighbours, weighted by visibility."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.autograd.function import FunctionCtx, once_differentiable

from geogs.depth.network.network_sizes import DepthNetworkOptions
from geogs.depth.network.plane_views import (
    PlaneViews,
    TriedDepths,
    cell_rays,
    sample_cells,
    see_planes,
)
from geogs.depth.network.stereo_views import StereoViews

VOXEL, PIXEL, PLANE = 4, 3, 3
"""Numbers of inputs: of a plane in a cell beside correlations, of a cell, of a plane in a view."""
MOST_LOGIT = 10.0
"""Bound of the logarithm of a view's weight."""
MULTIPLE = 8
"""The first layer's inputs are padded to a multiple of this many rows, which suits matrix units."""


class PlaneScorer(nn.Module):
    """Rates every plane of every cell in one neighbour: a score and its weight.

    Inputs of a small network are the correlations and the geometry: whether, how obliquely and how
    near the point is seen and how far it moves from plane to plane (after SimpleRecon's metadata).
    """

    def __init__(self, options: DepthNetworkOptions) -> None:
        super().__init__()
        width = options.metadata
        self.groups = options.groups
        self.matching = options.matching
        self.voxel = _weight(width, options.groups + VOXEL)
        self.pixel = nn.Linear(PIXEL, width)
        self.plane = nn.Linear(PLANE, width, bias=False)
        self.hidden = _weight(width, width)
        self.hidden_bias = _bias(width)
        self.out = _weight(2, width)
        self.out_bias = _bias(2)

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
        own = own.float().contiguous()
        theirs = theirs.float().contiguous()
        pixel = torch.cat([rays[:, :2], _roughness(own)], 1)
        scores = []
        weights = []
        masks = []
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


def rate_planes(
    own: Float[Tensor, "b c p"],
    found: Float[Tensor, "b c d p"],
    voxel: Float[Tensor, "b v d p"],
    pixel: Float[Tensor, "b x p"],
    plane: Float[Tensor, "b d y"],
    layers: list[Tensor],
) -> Float[Tensor, "b o d p"]:
    """Output of three layers with ReLU between them for the products of ``own`` and ``found``,
    channel by channel, and the inputs of voxels, pixels and planes, in this order.

    ``layers`` are a weight and a bias for each layer. Voxels and planes get no gradient. Layers
    are in bfloat16 on a GPU; the result is float32.
    """
    result: Tensor = _RatePlanes.apply(own, found, voxel, pixel, plane, *layers)
    return result


class _RatePlanes(torch.autograd.Function):
    """The small network over all planes and cells at once, which moves most of the memory.

    Its gradients are written out: then only the three layers' inputs are kept, in bfloat16 on a
    GPU, and one product per plane of a batch keeps a GPU busy where one per batch does not.
    """

    @staticmethod
    def forward(
        ctx: FunctionCtx,
        own: Tensor,
        found: Tensor,
        voxel: Tensor,
        pixel: Tensor,
        plane: Tensor,
        *layers: Tensor,
    ) -> Tensor:
        b, c, d, p = found.shape
        kind = torch.bfloat16 if own.is_cuda else own.dtype
        weights = [w.to(kind) for w in layers[::2]]
        biases = [x.to(kind) for x in layers[1::2]]
        pad = -weights[0].shape[1] % MULTIPLE
        weights[0] = torch.nn.functional.pad(weights[0], (0, pad))
        x = own.new_empty(b, d, weights[0].shape[1], p, dtype=kind)
        torch.mul(found.transpose(1, 2), own[:, None], out=x[:, :, :c])
        at = c
        for part in (voxel.transpose(1, 2), pixel[:, None], plane[..., None]):
            x[:, :, at : at + part.shape[2]] = part
            at += part.shape[2]
        x[:, :, at:] = 0
        inputs = [x.flatten(0, 1)]
        for n, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            y = _apply(weight, inputs[-1], bias)
            inputs.append(y.relu_() if n < 2 else y)
        ctx.save_for_backward(own, found, *inputs[:3], *weights)
        ctx.rows = [voxel.shape[1], pixel.shape[1], plane.shape[2]]  # type: ignore[attr-defined]
        return inputs[3].unflatten(0, (b, d)).transpose(1, 2).float()

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, gradient: Tensor) -> tuple[Tensor | None, ...]:
        own, found, *rest = ctx.saved_tensors  # type: ignore[attr-defined]
        inputs = rest[:3]
        weights = rest[3:]
        b, c, d = found.shape[:3]
        g = gradient.transpose(1, 2).to(inputs[0].dtype).flatten(0, 1)
        layers: list[Tensor] = []
        for n in (2, 1, 0):
            # Sums within a plane are of the product's precision, those over planes of float32.
            of_weight = torch.bmm(g, inputs[n].mT).sum(0, dtype=own.dtype)
            layers = [of_weight, g.sum((0, 2), dtype=own.dtype), *layers]
            g = torch.bmm(weights[n].T.expand(len(g), -1, -1), g)
            if n:
                g = torch.ops.aten.threshold_backward(g, inputs[n], 0)
        voxels, pixels, planes = ctx.rows  # type: ignore[attr-defined]
        layers[0] = layers[0][:, : c + voxels + pixels + planes]
        g = g.unflatten(0, (b, d))
        of_pixel = g[:, :, c + voxels : c + voxels + pixels].sum(1, dtype=own.dtype)
        product = g[:, :, :c].transpose(1, 2)
        of_found = torch.mul(product, own[:, :, None], out=torch.empty_like(found))
        of_own = (product * found).sum(2)
        return of_own, of_found, None, of_pixel, None, *layers


def _apply(
    weight: Float[Tensor, "o i"], x: Float[Tensor, "n i p"], bias: Float[Tensor, " o"]
) -> Float[Tensor, "n o p"]:
    n, _, p = x.shape
    return torch.baddbmm(bias[:, None].expand(n, -1, p), weight.expand(n, -1, -1), x)
