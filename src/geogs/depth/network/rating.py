"""The small network over all planes and cells at once, which moves most of the memory in training.

Its gradients are written out: then only the three layers' inputs are kept, in bfloat16 on a GPU,
and one product per plane of a batch keeps a GPU busy where one per batch does not.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import FunctionCtx, once_differentiable

MULTIPLE = 8
"""The first layer's inputs are padded to a multiple of this many rows, which suits matrix units."""


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
        weights, biases = [w.to(kind) for w in layers[::2]], [x.to(kind) for x in layers[1::2]]
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
        inputs, weights = rest[:3], rest[3:]
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
