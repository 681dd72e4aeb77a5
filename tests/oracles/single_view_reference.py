"""The paper's losses on one rendered view in plain PyTorch: per pixel, of any dtype and device.

Maps are rendered at ``(h, w)``: depth along z in map units (0 where nothing was hit), the blended
normal in the camera frame (not of unit length), alpha in [0, 1] and the distortion map. Each term
returns the loss of every pixel and the mask where it counts, outside which it is 0.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.config import LossConfig
from geogs.geometry.camera import Camera
from geogs.geometry.depth_maps import normals_from_depth
from geogs.losses.single_view import (
    NORMAL_EPSILON,
    SMOOTHNESS_ETA,
    ViewConstants,
    gradient_norm,
    visible,
)


def _masked(loss: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    return torch.where(mask, loss, torch.zeros_like(loss)), mask


def _unit(normal: Tensor) -> Tensor:
    return normal * (normal.square().sum(-1, keepdim=True) + NORMAL_EPSILON).rsqrt()


def normal_consistency(
    depth: Float[Tensor, "h w"],
    normal: Float[Tensor, "h w 3"],
    edge: Float[Tensor, "h w"],
    camera: Camera,
) -> tuple[Float[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """``(1 - g) (1 - N . N_d)``: paper Eq. normal_consistency with N_d of Eq. depth_normal.

    N is normalised first (the printed blend is shorter than 1 where alpha is, which would pull
    against opacity), N_d faces the camera, g is the view's ``edge``. Counts where the pixel and its
    four neighbours have depth.
    """
    from_depth, valid = normals_from_depth(depth, camera)
    agreement = (_unit(normal) * from_depth).sum(-1)
    return _masked((1 - edge) * (1 - agreement), valid)


def depth_smoothness(
    depth: Float[Tensor, "h w"],
    image_gradient: Float[Tensor, "h w"],
    eta: float = 10.0,
    reward_edges: bool = True,
) -> tuple[Float[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """``|grad D| exp(-eta |grad I|) + |grad I| exp(-eta |grad D|)``: paper Eq. depth_smoothness.

    D is divided by its (constant) median, so that the loss has no unit; gradients are
    :func:`gradient_norm`. The second term does not allow but reward a depth step at every image
    edge; without ``reward_edges`` only the first one, the usual edge-aware smoothness, is kept.
    Counts where the pixel and its right and lower neighbours have depth.
    """
    known = depth > 0
    inner = known[:-1, :-1] & known[:-1, 1:] & known[1:, :-1]
    valid = F.pad(inner, (0, 1, 0, 1))
    if not bool(valid.any()):
        return _masked(depth, valid)
    step = gradient_norm(depth / depth.detach()[known].median())
    loss = step * (-eta * image_gradient).exp()
    if reward_edges:
        loss = loss + image_gradient * (-eta * step).exp()
    return _masked(loss, valid)


def distortion(
    distortion_map: Float[Tensor, "h w"], mask: Bool[Tensor, "h w"], unit: float = 1.0
) -> tuple[Float[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """``sum_ij w_i w_j |z_i - z_j|`` over a length unit: paper Eq. distortion.

    The sum is the renderer's map, in map units.

    ``unit`` is a length in map units (for example the median depth of the first keyframe), which
    makes the weight of the term independent of the map's scale.
    """
    return _masked(distortion_map / unit, mask)


def depth_l1(
    depth: Float[Tensor, "h w"],
    prior: Float[Tensor, "h w"],
    confidence: Float[Tensor, "h w"] | None = None,
    relative: bool = True,
) -> tuple[Float[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """``|D - D_f| / D_f`` times confidence, or ``|D - D_f|`` as printed: paper Eq. depth_l1.

    The relative form has no unit and matches the error of a depth from parallax, which grows with
    depth. Counts where both depths are known (positive).
    """
    known = (depth > 0) & (prior > 0)
    error = (depth - torch.where(known, prior, depth.detach())).abs()
    if relative:
        error = error / torch.where(known, prior, torch.ones_like(prior))
    return _masked(error if confidence is None else error * confidence, known)


def normal_l1(
    normal: Float[Tensor, "h w 3"], prior: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"]
) -> tuple[Float[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """``|N - N_f|_1``, the sum over the three components: paper Eq. normal_l1.

    N is normalised first; a zero prior means unknown.
    """
    known = mask & (prior.square().sum(-1) > 0)
    return _masked((_unit(normal) - prior).abs().sum(-1), known)


def opacity(
    alpha: Float[Tensor, "h w"], mask: Bool[Tensor, "h w"] | None = None
) -> tuple[Float[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """``1 - alpha``; not in the paper, but without colour nothing else closes holes."""
    finite = torch.isfinite(alpha)
    return _masked(1 - alpha, finite if mask is None else finite & mask)


def silhouette(
    alpha: Float[Tensor, "h w"], outside: Bool[Tensor, "h w"]
) -> tuple[Float[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """``alpha`` where a mask says that nothing is; not in the paper, which has no masks."""
    return _masked(alpha, torch.isfinite(alpha) & outside)


def single_view_loss(
    depth: Float[Tensor, "h w"],
    normal: Float[Tensor, "h w 3"],
    alpha: Float[Tensor, "h w"],
    distortion_map: Float[Tensor, "h w"],
    view: ViewConstants,
    config: LossConfig,
    unit: float,
) -> Float[Tensor, ""]:
    """Weighted sum of the single-view terms: paper Eq. single_loss, plus the opacity term.

    Each term is summed over the pixels where it counts and divided by the number of all pixels, so
    that a small valid region does not get large gradients. ``unit`` as in :func:`distortion`.
    Where the view's prior depth is ``OUTSIDE`` only the silhouette counts.
    """
    inside = view.prior_depth >= 0
    mask = visible(depth, alpha) & inside
    zero = torch.zeros_like(depth)
    depth = torch.where(mask, depth, zero)
    normal = torch.where(mask[..., None] & torch.isfinite(normal), normal, zero[..., None])
    spread = torch.where(torch.isfinite(distortion_map), distortion_map, zero)
    terms = [(config.opacity_weight, opacity(alpha, inside))]
    terms.append((config.silhouette_weight, silhouette(alpha, ~inside)))
    if config.depth_weight > 0:
        loss = depth_l1(depth, view.prior_depth, view.confidence, config.ablation.depth_relative)
        terms.append((config.depth_weight, loss))
    if config.distortion_weight > 0:
        terms.append((config.distortion_weight, distortion(spread, mask, unit)))
    if config.normal_consistency_weight > 0:
        loss = normal_consistency(depth, normal, view.edge, view.camera)
        terms.append((config.normal_consistency_weight, loss))
    if config.normal_weight > 0 and view.prior_normal is not None:
        terms.append((config.normal_weight, normal_l1(normal, view.prior_normal, mask)))
    if config.smoothness_weight > 0:
        both = config.ablation.smoothness_rewards_edges
        loss = depth_smoothness(depth, view.image_gradient, SMOOTHNESS_ETA, both)
        terms.append((config.smoothness_weight, loss))
    total = torch.stack([weight * loss.sum() for weight, (loss, _) in terms]).sum()
    return total / depth.numel()
