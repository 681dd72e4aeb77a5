"""The losses of a window of views and their gradients, in a few kernel launches.

Same definitions as :mod:`geogs.losses.cpu`, in float32, for all views and pairs at once. The
gradient is computed with the value. A launch allocates nothing and never waits for the device, so
it can be part of a captured graph; the views and pairs may change between replays.
"""

from enum import IntFlag
from pathlib import Path

import torch
from jaxtyping import Float32, Float64, Int32, Int64
from torch import Tensor

from geogs.config import LossConfig
from geogs.gpu.kernels import kernels_for
from geogs.losses.cuda.view_table import ViewTable
from geogs.losses.kernel_settings import photo_settings, single_view_settings
from geogs.losses.multi_view import compared_planes
from geogs.losses.single_view import MIN_ALPHA

_SOURCE = Path(__file__).with_name("losses.cu")
# As in the sources: columns a block walks down, rows of a block of other kernels.
_STRIP, _WARP_ROWS, _MOTION_ROWS = 128, 32, 64
# Rows that a strip is cut into: more share the windows' first rows, fewer fill the device better.
_STRIP_ROWS = 64
_SSIM_HALF = 5


class _Flags(IntFlag):
    """Steps before and after a windowed measure; the bits of ``windows.cuh``."""

    ADD_EARLIER = 1
    FINISH = 2
    KEEP_GRADIENT = 4


class WindowLosses:
    """L_geo of up to ``views`` views with up to ``partners`` partners each.

    The loss of a view is its single-view loss plus ``pair_weight`` times the multi-view loss of
    each of its pairs (so one over the number of partners that a view should have). ``unit`` is a
    length in map units that makes the distortion term unitless. ``with_pose`` also gives the
    gradient in the pairs' relative motions.
    """

    def __init__(
        self,
        table: ViewTable,
        config: LossConfig,
        unit: float,
        views: int,
        partners: int,
        pair_weight: float,
        with_pose: bool = False,
    ) -> None:
        self.table = table
        self.config = config
        self.views = views
        self.partners = partners
        self._with_pose = with_pose
        self._kernels = kernels_for(_SOURCE, table.device)
        weights = (config.l1_weight, config.ssim_weight, config.ncc_weight)
        self._photo = partners > 0 and max(weights) > 0
        self._view_settings = self._uploaded(single_view_settings(config, table.render, unit))
        self._photo_settings = self._uploaded(photo_settings(config, table.photo, pair_weight))
        self._compared = [
            (k, c, self._uploaded(photo_settings(c, table.photo, pair_weight)))
            for k, c in compared_planes(config)
        ]
        """Planes of the photometric images with their weights."""
        device = table.device
        pairs = views * partners

        def maps(*shape: int) -> Float32[Tensor, "..."]:
            return torch.zeros(shape, dtype=torch.float32, device=device)

        self._clean = maps(views, table.render.height, table.render.width)
        self._inverse_median = maps(views)
        self._motions = maps(pairs, 12)
        self._targets = torch.full((pairs,), -1, dtype=torch.int32, device=device)
        size = (pairs if self._photo else 0, table.photo.height, table.photo.width)
        self._warped = maps(*size)
        self._pull = maps(*size)
        two_measures = config.ssim_weight > 0 and config.ncc_weight > 0 and not config.colour
        keeps_gradient = self._photo and (with_pose or two_measures)
        self._image_gradient = maps(*size) if keeps_gradient else None

    def _uploaded(self, settings: tuple[float | bool, ...]) -> Float32[Tensor, "k"]:
        return torch.tensor(settings, dtype=torch.float32, device=self.table.device)

    def launch(
        self,
        batch: Int32[Tensor, "b"],
        pairs: Int32[Tensor, "b p"],
        depth: Float32[Tensor, "b h w"],
        normal: Float32[Tensor, "b 3 h w"],
        alpha: Float32[Tensor, "b h w"],
        distortion: Float32[Tensor, "b h w"],
        d_depth: Float32[Tensor, "b h w"],
        d_normal: Float32[Tensor, "b 3 h w"],
        d_alpha: Float32[Tensor, "b h w"],
        d_distortion: Float32[Tensor, "b h w"],
        loss: Float32[Tensor, "b"],
        relative_gradient: Float64[Tensor, "b p 12"] | None = None,
    ) -> None:
        """Losses (map units as the views') and gradients of the views in the slots ``batch``.

        ``pairs`` holds the partners' slots; -1 stands for no view and no partner. ``depth`` and the
        other rendered maps are as in ``fused_single_view``, with normals in planes. All outputs are
        overwritten, the four gradients everywhere. ``relative_gradient`` (needs ``with_pose``) is
        d loss / d T of the rows of T = T_partner T_view^-1. All tensors lie on the device,
        contiguous.
        """
        assert (relative_gradient is not None) == self._with_pose
        t = self.table
        kernels = self._kernels
        c = self.config
        height, width = t.render.height, t.render.width
        views = self.views
        partners = self.partners
        kernels["begin_window"](
            _blocks(max(views * partners, views), 128), 128, batch, pairs, t.poses,
            self._photo_settings, self._targets, self._motions, loss, relative_gradient,
            views, partners,
        )  # fmt: skip
        if c.smoothness_weight > 0:
            maps = (batch, t.pointers, depth, alpha, self._inverse_median)
            kernels["inverse_median"](views, 1024, *maps, height * width, MIN_ALPHA)
        kernels["single_view"](
            (_blocks(width, 32), _blocks(height, 16), views), 256, batch, t.pointers,
            self._view_settings, depth, normal, alpha, distortion, self._inverse_median,
            self._clean, d_depth, d_normal, d_alpha, d_distortion, loss, height, width,
        )  # fmt: skip
        for plane, weights, settings in self._compared if self._photo else ():
            self._launch_pairs(
                t.planes[plane], weights, settings, batch, d_depth, loss, relative_gradient
            )

    def _launch_pairs(
        self,
        pointers: Int64[Tensor, "slots fields"],
        c: LossConfig,
        settings: Float32[Tensor, "k"],
        batch: Int32[Tensor, "b"],
        d_depth: Float32[Tensor, "b h w"],
        loss: Float32[Tensor, "b"],
        relative_gradient: Float64[Tensor, "b p 12"] | None,
    ) -> None:
        """Adds the multi-view terms of a plane, given the visible depth and the pairs' motions."""
        t = self.table
        kernels = self._kernels
        pairs = self.views * self.partners
        height, width = t.photo.height, t.photo.width
        sizes = (t.render.height, t.render.width, height, width, self.partners)
        windowed = c.ssim_weight > 0 or c.ncc_weight > 0
        columns = _blocks(width, 32)
        kernels["warp_pairs"](
            (columns, _blocks(height, _WARP_ROWS), pairs), (32, 8), batch, self._targets,
            self._motions, pointers, t.rendered, t.deviations, settings, self._clean, self._warped,
            self._pull, self._image_gradient, loss, *sizes, not windowed,
        )  # fmt: skip

        def compare(kernel: str, half: int, flags: _Flags) -> None:
            """Launch a measure of windows that reach ``half`` pixels to each side."""
            grid = (_blocks(width, _STRIP - 4 * half), _blocks(height, _STRIP_ROWS), pairs)
            kernels[kernel](
                grid, _STRIP, batch, self._targets, pointers, t.deviations, settings, self._warped,
                self._pull, self._image_gradient, loss, height, width, self.partners, _STRIP_ROWS,
                int(flags),
            )  # fmt: skip

        keep = _Flags.KEEP_GRADIENT if self._with_pose else _Flags(0)
        if c.ssim_weight > 0:
            flags = _Flags(0) if c.ncc_weight > 0 else _Flags.FINISH | keep
            compare("compare_structure", _SSIM_HALF, flags)
        if c.ncc_weight > 0:
            earlier = _Flags.ADD_EARLIER if c.ssim_weight > 0 else _Flags(0)
            flags = earlier | _Flags.FINISH | keep
            compare(f"correlate_{c.ncc_patch}", c.ncc_patch // 2, flags)
        if relative_gradient is not None:
            grid = (columns, _blocks(height, _MOTION_ROWS), pairs)
            given = (self._targets, self._motions, pointers, settings)
            maps = (self._clean, self._warped, self._image_gradient)
            kernels["motion_gradient"](grid, (32, 8), *given, *maps, relative_gradient, *sizes)
        grid = (_blocks(t.render.width, 32), _blocks(t.render.height, 8), self.views)
        kernels["gather_depth_gradient"](grid, (32, 8), self._targets, self._pull, d_depth, *sizes)

    def store_rendered(
        self,
        batch: Int32[Tensor, "b"],
        depth: Float32[Tensor, "b h w"],
        alpha: Float32[Tensor, "b h w"],
    ) -> None:
        """Keep the visible depth of views for other views' occlusion tests; slots -1 are skipped.

        If a slot comes twice, one of its depths is kept.
        """
        pixels = depth.shape[1] * depth.shape[2]
        grid = (_blocks(pixels, 256), len(batch))
        stored = (self.table.pointers, self.table.rendered)
        maps = (depth, alpha)
        self._kernels["store_rendered"](grid, 256, batch, *stored, *maps, pixels, MIN_ALPHA)


def _blocks(size: int, block: int) -> int:
    return -(-size // block)
