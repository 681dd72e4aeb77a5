"""Photometric check of a pose: whether two images agree at it.

A smoothed flow agrees with itself, there and back, even between images that have nothing in common,
so that is no evidence. The images themselves are: if they show the same surface, the window around
a cell of the first correlates with the second image where pose and depth, not the flow, project it.
"""

from dataclasses import dataclass
from math import gcd

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from geogs.gpu.transfer import to_device
from geogs.world.grid import STRIDE, SampleGrid

SIDE = STRIDE + 1
"""Pixels along the edge of a window; those of neighbouring cells share their border."""
MIN_NCC = 0.5
"""Least median correlation (NCC) of windows of 9 x 9 pixels, reprojected by pose and depth, for a
frame to count as located. Different scenes give 0, the same position 0.7 and more. Where too few
windows have texture, flow alone decides whether the camera is still near its expected pose; but no
map is started, and no camera relocalised, without this check."""
MIN_CONTRAST = 2.0
"""Least standard deviation in grey levels of a window with texture, after smoothing."""
MAX_WINDOWS = 512
"""Most windows that are compared, evenly spread; more would hardly change their median."""
MIN_WINDOWS = 24
"""Fewest windows whose median is meaningful."""


@dataclass(frozen=True)
class PhotometricCheck:
    """Agreement of two images at a pose."""

    correlation: float
    """Median normalised cross-correlation (NCC) of the windows, in [-1, 1]; 0 without any."""
    windows: int
    """Number of windows with texture and known depth, in view of both images."""

    @staticmethod
    def of(numbers: Float[Tensor, "2"]) -> "PhotometricCheck":
        """Make a check from the result of :func:`correlation_at`; waits for a GPU."""
        correlation, windows = numbers.tolist()
        return PhotometricCheck(correlation, int(windows))

    def passes(self, min_correlation: float, is_expected: bool) -> bool:
        """Whether a pose is accepted.

        With too few windows a pose is only accepted if ``is_expected``: near the one before it.
        """
        if self.windows < MIN_WINDOWS:
            return is_expected
        return self.correlation >= min_correlation


def correlation_at(
    grid: SampleGrid,
    first: Float[Tensor, "h w"],
    second: Float[Tensor, "h w"],
    T_ji: Float[Tensor, "4 4"],
    inverse_depth: Float[Tensor, "p"],
    information: Float[Tensor, "p"],
) -> Float[Tensor, "2"]:
    """Compute the numbers of a :class:`PhotometricCheck` for two grey images at a relative pose.

    Depth is the first's, and unknown where it has no information. All tensors except the pose,
    which may be on the CPU, are on the grid's device; so is the result, and nothing waits for a
    GPU.
    """
    if grid.on_gpu:
        from geogs.tracking.cuda.photometric_check import median_correlation

        step = _spread(grid).step
        at = (to_device(T_ji, first.device), inverse_depth, information)
        return median_correlation(grid, first, second, step, MIN_CONTRAST**2, *at)
    some = _spread(grid)
    positions = reprojected_windows(grid, T_ji, inverse_depth)
    return _median_correlation(grid, first, second, positions, information[some] > 0)


def correlation_matched(
    grid: SampleGrid,
    first: Float[Tensor, "h w"],
    second: Float[Tensor, "h w"],
    pixels: Float[Tensor, "p 2"],
) -> Float[Tensor, "2"]:
    """Do :func:`correlation_at` without a pose: cells lie at ``pixels`` of the second image.

    A weaker test, since flow leads to similar positions; but it cannot make images similar.
    """
    if grid.on_gpu:
        from geogs.tracking.cuda.photometric_check import median_correlation

        step = _spread(grid).step
        return median_correlation(grid, first, second, step, MIN_CONTRAST**2, pixels=pixels)
    some = _spread(grid)
    positions = pixels[some, None] + _offsets(grid)
    every = torch.ones(len(positions), dtype=torch.bool)
    return _median_correlation(grid, first, second, positions, every)


def matched_motion(
    grid: SampleGrid, pixels: Float[Tensor, "p 2"], weight: Float[Tensor, "p 2"]
) -> Float[Tensor, "2"]:
    """Return the fraction of matched cells, and their median motion in pixels, 0 without any.

    On a GPU both stay there, and nothing waits.
    """
    if grid.on_gpu:
        from geogs.tracking.cuda import photometric_check

        return photometric_check.matched_motion(grid, pixels, weight)
    used = weight[:, 0] > 0
    median = _median_where((pixels - grid.pixels).norm(dim=-1), used)[:1]
    return torch.cat([used.to(median).mean()[None], median])


def reprojected_windows(
    grid: SampleGrid, T_ji: Float[Tensor, "4 4"], inverse_depth: Float[Tensor, "p"]
) -> Float[Tensor, "n s 2"]:
    """Project the windows around some cells of the first view into a second, pixel by pixel.

    The surface in a window is assumed to have its cell's depth: the window is rotated, scaled and
    sheared like that plane. Pixels that are not in front of the second camera are not finite.
    """
    c = grid.camera
    some = _spread(grid)
    rays = grid.rays[some]
    R = T_ji[:3, :3].to(rays)
    middle = rays @ R.mT + inverse_depth[some, None] * T_ji[:3, 3].to(rays)
    offsets = (_offsets(grid) / rays.new_tensor([c.fx, c.fy])).expand(len(rays), -1, -1)
    around = c.unbent_step(rays[:, None, :2], offsets) @ R[:, :2].mT
    x, y, z = (middle[:, None] + around).unbind(-1)
    z = torch.where(z > 1e-6, z, torch.nan)
    return c.pixels(torch.stack([x / z, y / z], -1))


def _median_correlation(
    grid: SampleGrid,
    first: Float[Tensor, "h w"],
    second: Float[Tensor, "h w"],
    positions: Float[Tensor, "n s 2"],
    known: Bool[Tensor, "n"],
) -> Float[Tensor, "2"]:
    """Return the median NCC of the known, textured windows of the first image in view of both."""
    sides = (grid.camera.width - 1, grid.camera.height - 1)
    position = torch.stack([positions[..., k] * (2 / sides[k]) - 1 for k in (0, 1)], -1)
    seen = (position.abs() <= 1).flatten(1).all(1)
    position = position.nan_to_num(0.0).clamp(-2, 2)
    there = functional.grid_sample(second[None, None], position[None], align_corners=True)[0, 0]
    a, b = (_smoothed(x) for x in (_windows(grid, first), there))
    contrast = a.square().mean(1)
    other = b.square().mean(1)
    ncc = (a * b).mean(1) / (contrast * other).sqrt().clamp(min=1e-6)
    return _median_where(ncc, known & seen & (contrast > MIN_CONTRAST**2))


def _windows(grid: SampleGrid, image: Float[Tensor, "h w"]) -> Float[Tensor, "n s"]:
    """Return windows around some cells; the border is replicated where one ends a pixel outside."""
    image = functional.pad(image[None, None], (0, 1, 0, 1), mode="replicate")[0, 0]
    every = image.unfold(0, SIDE, STRIDE).unfold(1, SIDE, STRIDE)
    return every.reshape(grid.size, SIDE**2)[_spread(grid)]


def _smoothed(windows: Float[Tensor, "n s"]) -> Float[Tensor, "n r"]:
    """Return 3 x 3 means less the window's mean, robust to noise and half-pixel shifts."""
    x = windows.reshape(-1, SIDE, SIDE)
    x = x[:, :-2] + x[:, 1:-1] + x[:, 2:]
    x = (x[..., :-2] + x[..., 1:-1] + x[..., 2:]).flatten(1) / 9
    return x - x.mean(1, keepdim=True)


def _median_where(values: Float[Tensor, "n"], counts: Bool[Tensor, "n"]) -> Float[Tensor, "2"]:
    """Return the lower median of the values that count, 0 without any, and their number.

    ``torch.nanmedian`` would wait for the GPU.
    """
    ordered = torch.where(counts, values, torch.inf).sort().values
    number = counts.sum()
    middle = ordered.gather(0, ((number - 1).clamp(min=0) // 2)[None])
    return torch.cat([torch.where(number > 0, middle, 0.0), number[None].to(middle)])


def _spread(grid: SampleGrid) -> slice:
    """Return a slice of every k-th cell, row by row: at most ``MAX_WINDOWS``, from all columns."""
    step = -(-grid.size // MAX_WINDOWS)
    while gcd(step, grid.width) > 1:
        step += 1
    return slice(None, None, step)


def _offsets(grid: SampleGrid) -> Float[Tensor, "s 2"]:
    """Return pixel offsets of a window from its middle, row by row."""
    d = torch.arange(SIDE, dtype=torch.float32, device=grid.device) - SIDE // 2
    return torch.stack([d.repeat(SIDE), d.repeat_interleave(SIDE)], -1)
