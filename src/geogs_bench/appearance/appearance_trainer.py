"""Training of the baseline within a time budget."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8

from geogs.errors import InputError
from geogs_bench.appearance.appearance_config import AppearanceConfig
from geogs_bench.appearance.appearance_disks import AppearanceDisks, disks_at_points
from geogs_bench.appearance.appearance_losses import normal_loss, photometric_loss
from geogs_bench.appearance.densify import GradientStatistics, refine
from geogs_bench.appearance.disk_optimizer import DiskOptimizer
from geogs_bench.appearance.rasteriser import Rasteriser, Rendering
from geogs_bench.appearance.training_schedule import RefinementClock, Schedule
from geogs_bench.appearance.training_views import DeviceView, TrainingView, scene_scale

FEWEST_POINTS = 10
OnTime = Callable[[float, AppearanceDisks], None]
"""Called with the training seconds so far and the disks; the clock is paused meanwhile."""


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
        start, paused = time.perf_counter(), 0.0
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
        if self._clock.gathers(step):
            self._gather(rendering, view)
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

    def _gather(self, rendering: Rendering, view: DeviceView) -> None:
        gradient = rendering.screen.grad
        if gradient is not None:
            shape = (view.camera.width, view.camera.height)
            self._gradients.add(gradient.reshape(-1, 2), rendering.visible, *shape)

    def _refine(self, step: float) -> None:
        kept, added = refine(
            self.disks, self._gradients.mean(), step, self.scene_scale, self.config, self._random
        )
        if len(kept) + len(added) >= FEWEST_POINTS:
            self._optimizer.change(kept, added)
        self._gradients = GradientStatistics(len(self._optimizer.disks), self._device)

    def _render(
        self,
        view: DeviceView,
        sh_degree: int,
        background: torch.Tensor | None,
        normals: bool,
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
