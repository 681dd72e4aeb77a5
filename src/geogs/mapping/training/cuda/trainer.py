"""Training the map on a GPU: whole steps captured in CUDA graphs and replayed."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from geogs.config import MappingConfig
from geogs.gpu.kernels import kernels_for
from geogs.gpu.recorded import recording
from geogs.gpu.transfer import to_device
from geogs.mapping.keyframe_views import MapView
from geogs.mapping.training.cuda.known_views import KnownViews
from geogs.mapping.training.cuda.pose_refine import refine_poses
from geogs.mapping.training.cuda.window_pass import WindowPass
from geogs.mapping.training.map_trainer import GRADIENT_LIMIT, Batch, learning_rates
from geogs.mapping.view_arrays import MapCameras
from geogs.splat.cuda import rasterize
from geogs.splat.optimizer import BETAS, EPSILON
from geogs.world.disks import GaussianMap

_ADAM = Path(rasterize.__file__).with_name("adam.cu")


class CudaTrainer:
    """As :class:`geogs.mapping.training.cpu.CpuTrainer`; the map never leaves the GPU.

    The views of every step and the factors of the learning rates are uploaded once per call; a
    step, from the rendering to Adam, is one CUDA graph that reads its row of that schedule. A step
    whose lists are too small changes nothing and is repeated with larger ones.
    """

    def __init__(
        self,
        disks: GaussianMap,
        cameras: MapCameras,
        config: MappingConfig,
        unit: float,
        resident: int,
    ) -> None:
        self.disks = disks
        self.config = config
        self.unit = unit
        self.known = KnownViews(cameras, disks.device, resident)
        self._programs: dict[tuple[int, int], _TrainingStep] = {}
        self._pose_pass: WindowPass | None = None
        self.coarse_part = 0.0

    def train(
        self, batches: Sequence[Batch], factors: Sequence[float] | None = None, coarse: bool = False
    ) -> None:
        """Adam steps on the summed losses of each batch of views with their partners."""
        assert not coarse, "a GPU trains at the full resolution"
        if not batches or len(self.disks) == 0:
            return
        everyone = {v.id: v for batch in batches for own, others in batch for v in (own, *others)}
        slots = dict(zip(everyone, self.known.slots(list(everyone.values())), strict=True))
        views = max(len(batch) for batch in batches)
        partners = self.config.photo.per_step
        rows = np.full((len(batches), views * (1 + partners)), -1, np.int32)
        for row, batch in zip(rows, batches, strict=True):
            for k, (view, others) in enumerate(batch):
                row[k] = slots[view.id]
                first = views + k * partners
                row[first : first + len(others)] = [slots[o.id] for o in others]
        program = self._program(views, partners)
        program.run(rows, np.ones(len(rows), np.float32) if factors is None else factors)

    def refine_poses(
        self, active: list[MapView], views: Mapping[int, MapView], config: MappingConfig
    ) -> dict[int, Float[Tensor, "4 4"]]:
        """Poses of the active keyframes that agree better with the map; the earliest stays."""
        window = self._pose_pass
        if window is None or window.views != len(active) or window.is_outdated(self.disks):
            table = self.known.table
            room = self.disks.capacity
            window = WindowPass(
                table, config.pose_loss, self.unit, len(active), 1, 1.0, room, for_poses=True
            )
            self._pose_pass = window
        return refine_poses(self.disks, active, views, self.known, window, config, self.unit)

    def forget_renders(self, views: Iterable[MapView]) -> None:
        """Discard the rendered depths of all views, as the map was moved."""
        self.known.table.forget_rendered()

    def _program(self, views: int, partners: int) -> "_TrainingStep":
        key = (views, partners)
        program = self._programs.get(key)
        if program is None or program.window.is_outdated(self.disks):
            program = _TrainingStep(self, views, partners)
            self._programs[key] = program
        return program


class _TrainingStep:
    """One training step of a given size, as a CUDA graph where there is a GPU."""

    def __init__(self, trainer: CudaTrainer, views: int, partners: int) -> None:
        disks = trainer.disks
        config = trainer.config
        self._trainer = trainer
        self._device = disks.device
        self._capacity = disks.capacity
        self._kernels = kernels_for(_ADAM, disks.device)
        self.window = WindowPass(
            trainer.known.table,
            config.loss,
            trainer.unit,
            views,
            partners,
            1 / config.photo.per_step,
            disks.capacity,
            fresh=config.photo.fresh,
        )
        integers = torch.zeros(2, dtype=torch.int32, device=disks.device)
        self._count = integers[:1]
        self._completed = integers[1:]
        self._base, self._rates = torch.zeros(2, 4, device=disks.device)
        self._schedule = torch.zeros(0, len(self.window.slots), dtype=torch.int32)
        self._factors = torch.zeros(0)
        self._graph: torch.cuda.CUDAGraph | None = None

    def run(self, rows: np.ndarray, factors: Sequence[float] | np.ndarray) -> None:
        """Train on the views of each row; waits for the last step."""
        self._upload(rows, factors)
        left = len(rows)
        while left > 0:
            for _ in range(left):
                self._step()
            left = len(rows) - int(self._completed)
            if left > 0:
                self._make_room()

    def _upload(self, rows: np.ndarray, factors: Sequence[float] | np.ndarray) -> None:
        if len(rows) > len(self._schedule):
            self._schedule = torch.zeros(rows.shape, dtype=torch.int32, device=self._device)
            self._factors = torch.zeros(len(rows), device=self._device)
            self._graph = None
        self._schedule[: len(rows)] = to_device(torch.from_numpy(rows), self._device)
        scale = torch.as_tensor(np.asarray(factors, np.float32))
        self._factors[: len(rows)] = to_device(scale, self._device)
        rates = torch.tensor(learning_rates(self._trainer.config, self._trainer.unit))
        self._base.copy_(to_device(rates, self._device))
        self._count.fill_(len(self._trainer.disks))
        self._completed.zero_()

    def _make_room(self) -> None:
        status = self.window.rasterizer.status
        self.window.reserve(int(status[0]))
        status.zero_()
        self._graph = None

    def _step(self) -> None:
        if self._graph is not None:
            self._graph.replay()
            return
        self._launch()  # the first step of its kind also loads the kernels
        if self._device.type == "cuda":
            with recording(self._device) as graph:
                self._launch()
            self._graph = graph

    def _launch(self) -> None:
        trainer = self._trainer
        p = self.window
        room = self._trainer.disks.room
        disk = trainer.config.disk
        assert p.d_disks is not None
        schedule = (self._schedule, self._factors, self._completed, self._base)
        self._kernels["begin_step"](1, 64, len(p.slots), *schedule, p.slots, self._rates)
        p.launch(room, self._count)
        bounds = (np.log(disk.min_scale * trainer.unit), np.log(disk.max_scale * trainer.unit))
        self._kernels["adam_step"](
            -(-self._capacity // 256), 256, self._capacity, self._count, p.rasterizer.status,
            self._completed, *room, *p.d_disks, *trainer.disks.training_room(), p.maps.visible,
            self._rates, *BETAS, EPSILON, GRADIENT_LIMIT, *bounds,
        )  # fmt: skip
