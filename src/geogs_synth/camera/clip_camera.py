"""The imperfect cameras that take the clips: flaws, motion blur, tone, noise, compression."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from geogs_synth.camera.camera_batch import CameraBatch
from geogs_synth.draw import Draw

TAPS = 9
"""Number of displaced images whose mean is a blurred one."""
_MIDDLE = 0.2
"""Brightness of a clip before its exposure is disturbed."""
_KNEE = 0.6
"""Brightness above which highlights are compressed instead of clipped."""
Matrix = tuple[tuple[float, float, float], ...]

_SIDE = 8
_TO_YCC: Matrix = ((0.299, 0.587, 0.114), (-0.1687, -0.3313, 0.5), (0.5, -0.4187, -0.0813))
_TO_RGB: Matrix = ((1.0, 0.0, 1.402), (1.0, -0.3441, -0.7141), (1.0, 1.772, 0.0))


@dataclass(frozen=True)
class RandomFlaws:
    """Flaws of each of n pictures; those of a clip resemble each other."""

    exposure: Float[Tensor, "n"]
    """Factor on the light."""
    balance: Float[Tensor, "n 3"]
    """Factor on each colour."""
    blur: Float[Tensor, "n t 2"]
    """Displacements of the images that a blurred one is the mean of, in image widths."""
    vignette: Float[Tensor, "n"]
    """Loss of light in the corners."""
    gamma: Float[Tensor, "n"]
    """Exponent from light to display values."""
    contrast: Float[Tensor, "n"]
    """Factor on the distance from middle grey."""
    saturation: Float[Tensor, "n"]
    """Factor on the distance from grey."""
    shot: Float[Tensor, "n"]
    """Standard deviation, at white, of the noise that grows with brightness."""
    read: Float[Tensor, "n"]
    """Standard deviation of the noise that does not depend on brightness."""
    compression: Float[Tensor, "n"]
    """Quantisation step of lossy compression in 8-bit levels; 0 for none."""


@dataclass(frozen=True)
class _ClipFlaws:
    """Strength of the flaws of each of b clips."""

    strength: Float[Tensor, "b"]
    """0 is clean, 1 as in a poor video."""
    views: int

    def vary(
        self, draw: Draw, common: float, own: float, channels: int = 1
    ) -> Float[Tensor, "n c"]:
        """Factors around 1 with one part common to a clip and one of each view's own."""
        b = len(self.strength)
        whole = draw.normal(common, b, 1, channels) + draw.normal(own, b, self.views, channels)
        return (self.strength[:, None, None] * whole).exp().flatten(0, 1)

    def amount(self, draw: Draw, chance: float, low: float, high: float) -> Float[Tensor, "n"]:
        """Zero for most clips; for the others log-uniform, a little different in each view."""
        b = len(self.strength)
        value = draw.chance(chance, b) * self.strength * draw.log_uniform(low, high, b)
        return (value[:, None] * draw.log_uniform(0.6, 1.6, b, self.views)).flatten()


def draw_flaws(
    draw: Draw, clips: int, views: int, clean: float = 0.3, disturbance: float = 1.0
) -> RandomFlaws:
    """Flaws of the views of clips, clip after clip.

    The fraction ``clean`` of the clips has nearly none; ``disturbance`` scales those of the others.
    """
    nearly_none = draw.chance(clean, clips)
    strength = torch.where(nearly_none, 0.05, draw.uniform(0.3, 1.0, clips)) * disturbance
    some = _ClipFlaws(strength, views)
    brightness = draw.normal(0.35, clips, 1).exp().expand(-1, views).flatten()
    return RandomFlaws(
        exposure=brightness * some.vary(draw, 0.15, 0.12)[:, 0],
        balance=some.vary(draw, 0.08, 0.03, 3),
        blur=_draw_blur(draw, some),
        vignette=some.amount(draw, 0.5, 0.05, 0.5).clamp_max(0.7),
        gamma=some.vary(draw, 0.12, 0.05)[:, 0] / 2.2,
        contrast=some.vary(draw, 0.15, 0.06)[:, 0],
        saturation=some.vary(draw, 0.25, 0.06)[:, 0],
        shot=some.amount(draw, 0.7, 0.004, 0.06),
        read=some.amount(draw, 0.7, 0.002, 0.02),
        compression=_steps(draw, some),
    )


def _draw_blur(draw: Draw, some: _ClipFlaws) -> Float[Tensor, "n t 2"]:
    """Out of focus: a disc; moved during the exposure: a line. In widths of an image."""
    radius = some.amount(draw, 0.3, 6e-4, 3e-3)
    length = some.amount(draw, 0.3, 1e-3, 1e-2)
    angle = draw.uniform(-3.15, 3.15, len(radius))
    way = torch.stack([angle.cos(), angle.sin()], -1) * length[:, None]
    k = torch.arange(TAPS)
    spiral = torch.stack([(2.4 * k).cos(), (2.4 * k).sin()], -1)
    disc = ((k + 0.5) / TAPS).sqrt()[:, None] * spiral
    disc = disc - disc.mean(0)
    # The line in another order than the disc, or both would make one bent line.
    line = (k * 4 % TAPS) / (TAPS - 1) - 0.5
    return disc * radius[:, None, None] + line[:, None] * way[:, None]


def _steps(draw: Draw, some: _ClipFlaws) -> Float[Tensor, "n"]:
    steps = some.amount(draw, 0.7, 2.0, 18.0)
    return torch.where(steps < 0.5, 0.0, steps)


def exposed(
    colour: Float[Tensor, "b v 3 h w"], blur: Float[Tensor, "b v h w 2"]
) -> Float[Tensor, "b v 3 h w"]:
    """Mean linear light along each pixel's motion, which is centred on the pixel."""
    b, v, _, h, w = colour.shape
    way = blur.flatten(0, 1).clamp(-40.0, 40.0)  # pixels
    step = torch.stack([way[..., 0] * (2 / w), way[..., 1] * (2 / h)], -1)
    shifts = [(tap / 10 - 0.5) * step for tap in range(11)]
    return mean_of_displaced(colour.flatten(0, 1), shifts).unflatten(0, (b, v))


def mean_of_displaced(
    image: Float[Tensor, "n 3 h w"], shifts: Sequence[Float[Tensor, "n #h #w 2"]]
) -> Float[Tensor, "n 3 h w"]:
    """The mean of an image displaced by each of some shifts, in half sizes of the image."""
    h, w = image.shape[-2:]
    x = (torch.arange(w, device=image.device) + 0.5) * (2 / w) - 1
    y = (torch.arange(h, device=image.device)[:, None] + 0.5) * (2 / h) - 1
    grid = torch.stack(torch.broadcast_tensors(x, y), -1)
    total = torch.zeros_like(image)
    for shift in shifts:
        total += torch.nn.functional.grid_sample(
            image, grid + shift, padding_mode="border", align_corners=False
        )
    return total / len(shifts)


def motion_while_open(
    views: CameraBatch,
    depth: Float[Tensor, "b v h w"],
    camera: Float[Tensor, "b v 6"],
    things: Float[Tensor, "b v h w 3"],
) -> Float[Tensor, "b v h w 2"]:
    """Pixels by which each point moves in the image while the shutter is open.

    ``camera`` is the motion of the camera in this time (rotation vector, translation, in its
    frame), ``things`` that of the points, world frame.
    """
    h, w = depth.shape[-2:]
    fx, fy, cx, cy = views.intrinsics[:, :, None, None, None].unbind(1)
    x = (torch.arange(w, device=depth.device) - cx) / fx
    y = (torch.arange(h, device=depth.device)[:, None] - cy) / fy
    ray = torch.stack(torch.broadcast_tensors(x, y, torch.ones_like(depth)), -1)
    point = ray * depth[..., None]
    rotation, way = (p[:, :, None, None].expand_as(point) for p in camera.split(3, -1))
    moved = torch.einsum("bvij,bvhwj->bvhwi", views.T_cw[..., :3, :3], things)
    rate = moved - way - torch.linalg.cross(rotation, point)
    across = (rate[..., :2] - ray[..., :2] * rate[..., 2:]) / depth[..., None].clamp_min(0.05)
    return across * torch.stack([fx, fy], -1)


def develop(
    noise: Draw, flaws: RandomFlaws, colour: Float[Tensor, "b v 3 h w"]
) -> Float[Tensor, "b v 3 h w"]:
    """Pictures (0..1 in 8-bit steps) of linear light, as imperfect cameras would take them."""
    b, v = colour.shape[:2]
    # The mean of roots: a bright window or lamp does not make everything else black.
    level = colour.sqrt().mean((1, 2, 3, 4)).square().clamp_min(1e-4)
    gain = (_MIDDLE / level).repeat_interleave(v) * flaws.exposure
    linear = colour.flatten(0, 1) * (gain[:, None] * flaws.balance)[..., None, None]
    linear = _blur(linear, flaws.blur) * _vignette(linear, flaws.vignette)
    image = _tone(linear, flaws)
    shot = _each(flaws.shot)
    read = _each(flaws.read)
    deviation = (shot.square() * image.clamp(0, 1) + read.square()).sqrt()
    image = (image + deviation * noise.normal(1.0, *image.shape)).clamp(0, 1)
    step = flaws.compression
    image = torch.where(_each(step) > 0, compress(image, step.clamp_min(0.5)), image)
    return ((image.clamp(0, 1) * 255).round() / 255).unflatten(0, (b, v))


def _each(number: Float[Tensor, "n"]) -> Float[Tensor, "n 1 1 1"]:
    return number[:, None, None, None]


def _blur(
    image: Float[Tensor, "n 3 h w"], displacements: Float[Tensor, "n t 2"]
) -> Float[Tensor, "n 3 h w"]:
    """The mean of displaced images."""
    h, w = image.shape[-2:]
    across = 2 * displacements[..., 0]
    down = 2 * displacements[..., 1] * (w / h)
    shifts = torch.stack([across, down], -1)[:, :, None, None].unbind(1)
    return mean_of_displaced(image, shifts)


def _vignette(
    image: Float[Tensor, "n 3 h w"], loss: Float[Tensor, "n"]
) -> Float[Tensor, "n 1 h w"]:
    h, w = image.shape[-2:]
    x = (torch.arange(w, device=image.device) + 0.5) / w - 0.5
    y = ((torch.arange(h, device=image.device) + 0.5) / h - 0.5)[:, None] * (h / w)
    return 1 - _each(loss) * (x * x + y * y) / (0.25 + 0.25 * (h / w) ** 2)


def _tone(linear: Float[Tensor, "n 3 h w"], flaws: RandomFlaws) -> Float[Tensor, "n 3 h w"]:
    """Linear light to display values."""
    over = (linear - _KNEE).clamp_min(0)
    bent = linear.clamp_max(_KNEE) + over / (1 + over)
    image = bent.clamp(1e-5, 1.0) ** _each(flaws.gamma)
    image = 0.5 + (image - 0.5) * _each(flaws.contrast)
    grey = image.mean(1, keepdim=True)
    return grey + (image - grey) * _each(flaws.saturation)


def compress(
    images: Float[Tensor, "n 3 h w"], step: Float[Tensor, "n"]
) -> Float[Tensor, "n 3 h w"]:
    """Images in 0..1 as they look after compression with a quantisation step.

    ``step`` is that of the lowest brightness frequency, in 8-bit levels: 2 is hardly seen, 30 is
    coarse. Steps grow with frequency, and are larger for colour, roughly as in JPEG's tables.
    """
    h, w = images.shape[-2:]
    padded = torch.nn.functional.pad(images, (0, -w % _SIDE, 0, -h % _SIDE), mode="replicate")
    rows, columns = padded.shape[2] // _SIDE, padded.shape[3] // _SIDE
    ycc = 255 * _mix(_TO_YCC, padded)
    basis = _cosines(images.device)
    frequency = torch.arange(_SIDE, device=images.device)
    growth = 1 + 0.75 * (frequency[:, None] + frequency).repeat(1, columns)
    colour = 1 + 0.8 * (torch.arange(3, device=images.device) > 0)
    table = step[:, None, None, None, None] * colour[:, None, None, None] * growth

    # Blocks stay in their rows of the image; a matrix for each of many tiny blocks would be slow.
    across = (ycc.unflatten(3, (columns, _SIDE)) @ basis.T).flatten(3)
    coefficients = basis @ across.unflatten(2, (rows, _SIDE))
    coefficients = (coefficients / table).round() * table
    down = (basis.T @ coefficients).flatten(2, 3)
    ycc = (down.unflatten(3, (columns, _SIDE)) @ basis).flatten(3)
    return _mix(_TO_RGB, ycc / 255)[:, :, :h, :w]


def _mix(matrix: Matrix, image: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
    """Linear transform of colours; plain numbers need not be sent to the device."""
    a, b, c = image.unbind(1)
    return torch.stack([r[0] * a + r[1] * b + r[2] * c for r in matrix], 1)


def _cosines(device: torch.device) -> Float[Tensor, "8 8"]:
    """Orthonormal basis of the discrete cosine transform, a frequency per row."""
    k = torch.arange(_SIDE, device=device)
    basis = torch.cos(math.pi / _SIDE * (k + 0.5) * k[:, None]) * math.sqrt(2 / _SIDE)
    return torch.where(k[:, None] == 0, math.sqrt(1 / _SIDE), basis)
