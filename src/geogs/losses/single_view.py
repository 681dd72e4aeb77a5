"""Losses on one rendered view: the paper's single-view terms, per pixel.

Maps are rendered at ``(h, w)``: depth along z in map units (0 where nothing was hit), the blended
normal in the camera frame (not of unit length), alpha in [0, 1] and the distortion map. Each term
returns the loss of every pixel and the mask where it counts, outside which it is 0.
"""

import functools
from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from geogs.config import LossConfig
from geogs.geometry.camera import Camera
from geogs.geometry.depth_maps import normals_from_depth

# Added to the squared length of a blended normal (about 1): bounds the slope of normalising it.
NORMAL_EPSILON = 1e-6
MIN_ALPHA = 0.5
"""Depth and normals count where alpha exceeds this: most of the light ends at the surface."""
SMOOTHNESS_ETA = 10.0
"""Decay of smoothness with the image gradient (image in [0, 1]); the paper's eta."""
OUTSIDE = -1.0
"""Prior depth where a mask says that nothing of the scene is."""
ONE_SURFACE = 0.08
"""Relative difference of inverse depth within a pixel of half the resolution up to which it has one
depth."""


@dataclass(frozen=True, eq=False)
class ViewConstants:
    """What the single-view losses know of a keyframe besides its rendering, at render size."""

    camera: Camera
    """Intrinsics at render size."""
    edge: Float[Tensor, "h w"]
    """Image gradient normalised to [0, 1], see :func:`edge_strength`."""
    image_gradient: Float[Tensor, "h w"]
    """Image gradient in grey values per pixel, see :func:`gradient_norm`."""
    prior_depth: Float[Tensor, "h w"]
    """The keyframe's own depth D_f in map units; 0 where unknown, ``OUTSIDE`` beyond a mask
    and in the sky."""
    confidence: Float[Tensor, "h w"]
    """Weight of the prior depth, in [0, 1] unless it was measured."""
    prior_normal: Float[Tensor, "h w 3"] | None = None
    """Unit normals N_f in the camera frame, facing the camera; zero where unknown."""

    @staticmethod
    def prepare(
        image: UInt8[np.ndarray, "ih iw 3"],
        camera: Camera,
        prior_depth: Float[Tensor, "h w"] | None = None,
        confidence: Float[Tensor, "h w"] | None = None,
        prior_normal: Float[Tensor, "h w 3"] | None = None,
    ) -> "ViewConstants":
        """Constants of a keyframe with this RGB image (any size) rendered by ``camera``.

        On the prior depth's device.
        """
        size = (camera.width, camera.height)
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        device = None if prior_depth is None else prior_depth.device
        rgb = torch.from_numpy(small).to(device).float() / 255
        unknown = torch.zeros(camera.height, camera.width, device=device)
        if confidence is None:
            confidence = torch.ones_like(unknown)
        return ViewConstants(
            camera=camera,
            edge=edge_strength(rgb),
            image_gradient=gradient_norm(rgb),
            prior_depth=unknown if prior_depth is None else prior_depth.float(),
            confidence=confidence.float(),
            prior_normal=None if prior_normal is None else prior_normal.float(),
        )

    @functools.cached_property
    def halved(self) -> "ViewConstants":
        """The same for maps of half the resolution.

        A pixel's depth, confidence and normal are means of those in it, and unknown where some are
        unknown or of another surface; it is ``OUTSIDE`` where most of it is.
        """
        camera = self.camera.resized(self.camera.width // 2, self.camera.height // 2)
        size = (camera.height, camera.width)
        known, outside = self.prior_depth > 0, self.prior_depth < 0
        inverse = torch.where(known, 1 / self.prior_depth.clamp(min=1e-9), 0.0)
        weight = torch.where(known, self.confidence, 0.0)
        maps = torch.stack(
            [self.edge, self.image_gradient, inverse, weight, known.float(), outside.float()]
        )
        edge, gradient, inverse_mean, mean_weight, share, beyond = F.adaptive_avg_pool2d(maps, size)
        most, least = F.adaptive_max_pool2d(torch.stack([inverse, -inverse]), size)
        one = (share > 0.999) & (most + least < ONE_SURFACE * inverse_mean)
        depth = torch.where(one, 1 / inverse_mean.clamp(min=1e-9), 0.0)
        normal = None
        if self.prior_normal is not None:
            mean = F.adaptive_avg_pool2d(self.prior_normal.movedim(-1, 0), size).movedim(0, -1)
            length = mean.norm(dim=-1, keepdim=True)
            normal = torch.where(length > 0.5, mean / length.clamp(min=1e-6), 0.0)
        return ViewConstants(
            camera, edge, gradient, torch.where(beyond > 0.5, OUTSIDE, depth),
            torch.where(one, mean_weight, 0.0), normal,
        )  # fmt: skip


def edge_strength(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
    """The paper's |grad I| "normalised to the range of 0 to 1"; 1 on the border ring.

    Central differences, mean over colours, the larger of the two directions, min-max normalised
    over the image (PGSR). A constant image has no edges: 0 inside.
    """
    horizontal = (image[1:-1, 2:] - image[1:-1, :-2]).abs().mean(-1)
    vertical = (image[2:, 1:-1] - image[:-2, 1:-1]).abs().mean(-1)
    g = torch.maximum(horizontal, vertical)
    low, high = g.aminmax()
    return F.pad((g - low) / (high - low).clamp(min=1e-6), (1, 1, 1, 1), value=1.0)


def gradient_norm(image: Float[Tensor, "h w *c"]) -> Float[Tensor, "h w"]:
    """1-norm of the forward differences per pixel, mean over channels; 0 in the last row, column.

    Of an image in grey values per pixel, of a depth map in its unit per pixel.
    """
    channels = image if image.ndim == 3 else image[..., None]
    horizontal = (channels[:-1, 1:] - channels[:-1, :-1]).abs()
    vertical = (channels[1:, :-1] - channels[:-1, :-1]).abs()
    return F.pad((horizontal + vertical).mean(-1), (0, 1, 0, 1))


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
    against opacity), N_d faces the camera, g is :func:`edge_strength`. Counts where the pixel and
    its four neighbours have depth.
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


def visible(
    depth: Float[Tensor, "h w"], alpha: Float[Tensor, "h w"], min_alpha: float = MIN_ALPHA
) -> Bool[Tensor, "h w"]:
    """The valid pixels Omega: a finite positive depth seen with more than ``min_alpha``."""
    return (alpha > min_alpha) & (depth > 0) & torch.isfinite(depth)


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
    Any dtype and device; :func:`geogs.losses.cpu.fused_single_view` is the same on a CPU, faster.
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
