"""Training of the baseline within a time budget, by the losses of 2DGS: L1, SSIM and normals."""

import functools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.autograd.function import once_differentiable

from geogs.errors import InputError
from geogs_bench.appearance.appearance_config import AppearanceConfig
from geogs_bench.appearance.appearance_disks import (
    AppearanceDisks,
    DiskOptimizer,
    GradientStatistics,
    disks_at_points,
    refine,
)
from geogs_bench.appearance.rasteriser import Rasteriser, Rendering
from geogs_bench.appearance.training_views import DeviceView, TrainingView, scene_scale

FEWEST_POINTS = 10
_WINDOW = 11
"""Side of the windows of SSIM, pixels."""
_C1 = 0.01**2
_C2 = 0.03**2
OnTime = Callable[[float, AppearanceDisks], None]
"""Called with the training seconds so far and the disks; the clock is paused meanwhile."""


@dataclass(frozen=True)
class Schedule:
    """The public schedule stretched over ``budget`` seconds."""

    config: AppearanceConfig
    budget: float
    """Seconds."""

    def step(self, elapsed: float) -> float:
        """Step of the public schedule that corresponds to ``elapsed`` seconds."""
        return self.config.steps * elapsed / self.budget

    def sh_degree(self, step: float) -> int:
        """Highest degree of the spherical harmonics in use."""
        return min(int(step // self.config.sh_interval), self.config.sh_degree)

    def means_rate(self, step: float, scene_scale: float) -> float:
        """Learning rate of positions, units of the poses."""
        part = min(step / self.config.steps, 1.0)
        return self.config.means_rate * scene_scale * self.config.means_decay**part

    def uses_normals(self, step: float) -> bool:
        """Whether the consistency of normals counts."""
        return self.config.normal_weight > 0 and step > self.config.normal_start


class RefinementClock:
    """Decides when disks are added and removed."""

    def __init__(self, config: AppearanceConfig) -> None:
        self._config = config
        self._step = float(config.refine_start)
        self._iteration = 0

    def gathers(self, step: float) -> bool:
        """Whether image gradients are still used."""
        return step < self._config.refine_stop

    def is_due(self, step: float, iteration: int) -> bool:
        """Whether to refine now; if so, the next interval begins now."""
        config = self._config
        due = (
            self.gathers(step)
            and step - self._step >= config.refine_every
            and iteration - self._iteration >= config.refine_iterations
        )
        if due:
            self._step = step
            self._iteration = iteration
        return due


@dataclass(frozen=True)
class AppearanceResult:
    """The trained disks, and the cost of their training."""

    disks: AppearanceDisks
    iterations: int
    seconds: float
    """Time of the training alone, on the clock of the budget."""
    psnr: float
    """Mean over the training images, inside their masks, dB."""


class AppearanceTrainer:
    """Disks in training; one random view an iteration.

    Images are copied to the device and disks are made before the clock starts.
    """

    def __init__(
        self,
        views: Sequence[TrainingView],
        points: Float[np.ndarray, "n 3"],
        colours: UInt8[np.ndarray, "n 3"],
        rasteriser: Rasteriser,
        config: AppearanceConfig,
        seed: int = 0,
        device: str = "cuda",
    ) -> None:
        if not len(views):
            raise InputError("There are no images to train the appearance baseline on.")
        if len(points) < FEWEST_POINTS:
            raise InputError(
                f"The appearance baseline starts from points, and there are only {len(points)}; "
                "the images may have too little texture."
            )
        self.config = config
        self.scene_scale = scene_scale(views, config.scene_margin)
        """Largest distance of a camera from their middle, with a margin; units of the poses."""
        self.iterations = 0
        self._device = torch.device(device)
        self._rasteriser = rasteriser
        self._views = [DeviceView(view, self._device) for view in views]
        self._random = torch.Generator(self._device).manual_seed(seed)
        self._order = np.random.default_rng(seed)
        self._queue: list[int] = []
        position = torch.from_numpy(np.asarray(points, np.float32)).to(self._device)
        colour = torch.from_numpy(np.asarray(colours)).to(self._device) / 255
        start = disks_at_points(position, colour, self.config, self._random)
        rate = self.config.means_rate * self.scene_scale
        self._optimizer = DiskOptimizer(start, self.config, rate)
        self._gradients = GradientStatistics(len(start), self._device)
        self._clock = RefinementClock(self.config)

    @property
    def disks(self) -> AppearanceDisks:
        """The current disks, without gradients; training changes them in place."""
        return self._optimizer.disks.map(lambda tensor: tensor.detach())

    def train(
        self, budget: float, at_seconds: Sequence[float] = (), on_time: OnTime | None = None
    ) -> AppearanceResult:
        """Train for ``budget`` seconds.

        ``on_time`` is called once at each of ``at_seconds``; calls at the budget or after it are
        made at the end.
        """
        schedule = Schedule(self.config, budget)
        self._warm_up(schedule)
        waiting = sorted(at_seconds)
        start = time.perf_counter()
        paused = 0.0
        while (elapsed := time.perf_counter() - start - paused) < budget:
            if waiting and on_time and elapsed >= waiting[0]:
                self._synchronise()
                before = time.perf_counter()
                waiting = [seconds for seconds in waiting if seconds > elapsed]
                on_time(elapsed, self.disks.detached())
                paused += time.perf_counter() - before
            self._iterate(schedule, schedule.step(elapsed))
        self._synchronise()
        elapsed = time.perf_counter() - start - paused
        disks = self.disks.detached()
        if waiting and on_time:
            on_time(elapsed, disks)
        return AppearanceResult(disks, self.iterations, elapsed, self.psnr())

    @torch.no_grad()
    def psnr(self) -> float:
        """Mean over the images of the peak signal-to-noise ratio inside their masks, dB."""
        values = []
        degree = self.config.sh_degree
        for view in self._views:
            colour = self._render(view, degree, None, False).colour
            error = (colour.clamp(0, 1) - view.target(None)).square()
            shown = error if view.mask is None else error[view.mask[..., 0]]
            if shown.numel():
                values.append(-10 * torch.log10(shown.mean().clamp(min=1e-12)))
        return float(torch.stack(values).mean()) if values else float("nan")

    def _iterate(self, schedule: Schedule, step: float) -> None:
        view = self._views[self._next()]
        rendering = self._backward(view, schedule, step)
        self.iterations += 1
        gradient = rendering.screen.grad
        if gradient is not None and self._clock.gathers(step):
            shape = (view.camera.width, view.camera.height)
            self._gradients.add(gradient.reshape(-1, 2), rendering.visible, *shape)
        self._optimizer.step(schedule.means_rate(step, self.scene_scale))
        if self._clock.is_due(step, self.iterations):
            self._refine(step)

    def _backward(self, view: DeviceView, schedule: Schedule, step: float) -> Rendering:
        background = None
        if view.mask is not None:
            background = torch.rand(3, generator=self._random, device=self._device)
        normals = schedule.uses_normals(step)
        rendering = self._render(view, schedule.sh_degree(step), background, normals)
        target = view.target(background)
        loss = photometric_loss(rendering.colour, target, self.config.ssim_weight)
        if rendering.normal is not None and rendering.depth_normal is not None:
            consistency = normal_loss(rendering.normal, rendering.depth_normal, rendering.alpha)
            loss = loss + self.config.normal_weight * consistency
        rendering.screen.retain_grad()
        loss.backward()
        return rendering

    def _refine(self, step: float) -> None:
        kept, added = refine(
            self.disks, self._gradients.mean(), step, self.scene_scale, self.config, self._random
        )
        if len(kept) + len(added) >= FEWEST_POINTS:
            self._optimizer.change(kept, added)
        self._gradients = GradientStatistics(len(self._optimizer.disks), self._device)

    def _render(
        self, view: DeviceView, sh_degree: int, background: torch.Tensor | None, normals: bool
    ) -> Rendering:
        disks = self._optimizer.disks
        return self._rasteriser.render(
            disks, view.camera, view.T_cw, sh_degree, background, normals
        )

    def _next(self) -> int:
        """Index of a random view; each comes once before any comes again."""
        if not self._queue:
            self._queue = self._order.permutation(len(self._views)).tolist()
        return self._queue.pop()

    def _warm_up(self, schedule: Schedule) -> None:
        """Run one pass with every loss and no step, so that libraries load outside the budget."""
        self._backward(self._views[0], schedule, float(self.config.steps))
        for tensor in self._optimizer.disks.tensors():
            tensor.grad = None
        self._synchronise()

    def _synchronise(self) -> None:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)


def ssim(one: Float[Tensor, "h w c"], other: Float[Tensor, "h w c"]) -> Float[Tensor, ""]:
    """Mean structural similarity (Wang et al. 2004) of two images in [0, 1].

    Gaussian windows of 11 pixels, sigma 1.5; only windows that lie wholly in the image count.
    Differentiable, once, in the first image alone.
    """
    return _StructuralSimilarity.apply(one, other)


def photometric_loss(
    rendered: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], ssim_weight: float
) -> Float[Tensor, ""]:
    """(1 - w) L1 + w (1 - SSIM), Kerbl et al. 2023, Eq. 7."""
    l1 = F.l1_loss(rendered, target)
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim(rendered, target))


def normal_loss(
    normal: Float[Tensor, "h w 3"],
    depth_normal: Float[Tensor, "h w 3"],
    alpha: Float[Tensor, "h w"],
) -> Float[Tensor, ""]:
    """Mean of 1 - n . N alpha: blended disk normals against those of the depth map.

    Huang et al. 2024, Eq. 14, with the weights' sum taken into the blended normal; the opacity
    is constant.
    """
    cosine = (normal * depth_normal).sum(-1) * alpha.detach()
    return 1 - cosine.mean()


class _StructuralSimilarity(torch.autograd.Function):
    """SSIM with its derivative written out: fewer operations, and all in full precision."""

    @staticmethod
    def forward(ctx: Any, one: Tensor, other: Tensor) -> Tensor:
        a, b = (image.permute(2, 0, 1).contiguous() for image in (one, other))
        mean_a, mean_b, square_a, square_b, product = _blur(
            torch.cat([a, b, a * a, b * b, a * b]), 0
        ).chunk(5)
        mean_ab = mean_a * mean_b
        mean_squares = mean_a.square().addcmul_(mean_b, mean_b)
        above_luminance = 2 * mean_ab + _C1
        above_structure = 2 * (product - mean_ab) + _C2
        below_luminance = mean_squares + _C1
        below_structure = square_a + square_b - mean_squares + _C2
        below = below_luminance * below_structure
        similarity = above_luminance * above_structure / below
        if ctx.needs_input_grad[0]:
            to_square = -similarity / below_structure
            to_product = 2 * above_luminance / below
            to_mean = 2 * mean_b * (above_structure - above_luminance) / below - 2 * mean_a * (
                similarity / below_luminance + to_square
            )
            ctx.save_for_backward(a, b, torch.cat([to_mean, to_square, to_product]))
        return similarity.mean()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        a, b, derivatives = ctx.saved_tensors
        to_mean, to_square, to_product = _blur(derivatives, _WINDOW - 1).chunk(3)
        total = (to_mean + 2 * a * to_square + b * to_product) * (
            gradient * (3 / derivatives.numel())
        )
        return total.permute(1, 2, 0), None


def _blur(images: Float[Tensor, "n h w"], padding: int) -> Float[Tensor, "n h2 w2"]:
    """Gaussian mean of each window; the images are padded with ``padding`` zeros.

    One convolution a channel, without cuDNN: its convolutions may round to the 10 bits of TF32,
    and then the variance, a difference of squares, is wrong by as much as the constants of SSIM.
    """
    n = len(images)
    kernel = _window(images.dtype, images.device).expand(n, 1, -1, 1)
    with torch.backends.cudnn.flags(enabled=False):
        rows = F.conv2d(images[None], kernel, padding=(padding, 0), groups=n)
        return F.conv2d(rows, kernel.transpose(2, 3), padding=(0, padding), groups=n)[0]


@functools.cache
def _window(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "1 1 11 1"]:
    offset = torch.arange(_WINDOW, dtype=dtype, device=device) - _WINDOW // 2
    kernel = torch.exp(-0.5 * (offset / 1.5) ** 2)
    return (kernel / kernel.sum()).view(1, 1, -1, 1)
