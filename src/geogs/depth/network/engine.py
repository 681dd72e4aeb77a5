"""Keyframe depths by the network, on the CPU or a GPU."""

import contextlib
import math
import threading
from collections.abc import Sequence
from dataclasses import replace

import cv2
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from geogs.depth.depth_engine import (
    AlternativeSearch,
    DepthEngine,
    DepthTask,
    Limits,
    Progress,
    silent,
)
from geogs.depth.depth_view import DenseDepth, DepthView, dense_depths, relative_poses
from geogs.depth.grid_completion import known_cells
from geogs.depth.network.model import DepthNetwork
from geogs.depth.network.search_range import SearchRange, search_range
from geogs.depth.network.stereo_views import DepthPrediction, StereoViews
from geogs.depth.sweep_neighbors import seen_inverse_depth
from geogs.geometry.camera import Camera
from geogs.gpu.recorded import Recorded
from geogs.gpu.transfer import to_device, upload
from geogs.world.lru import LruCache

EDGE = 512
"""Longest edge of the network's images, pixels, as in its training."""
MOST_NEIGHBOURS = 8
"""Most neighbours, as in the training; the best are used."""
MOST_ANGLE = math.radians(15)
"""Expected error above which a normal counts as unknown."""
_EDGE = 0.02
"""Relative difference to the nearest pixel's depth above which an interpolated depth lies between
two surfaces."""


class NetworkDepthEngine(AlternativeSearch):
    """Estimates depths, normals and confidence by the network where there are neighbours.

    Images of the ``resident`` keyframes used last stay on the device.
    """

    def __init__(
        self,
        network: DepthNetwork,
        classical: DepthEngine,
        device: torch.device,
        render: Camera,
        working: Camera,
        resident: int,
    ) -> None:
        super().__init__(classical)
        self.device = device
        self.render = render
        self.working = working
        self.seen = working.with_long_edge(min(EDGE, max(working.width, working.height)))
        self.network = network.to(device)
        lens = [self.seen.fx, self.seen.fy, self.seen.cx, self.seen.cy]
        self._intrinsics = torch.tensor([lens], dtype=torch.float32, device=device)
        self._recorded = Recorded(
            lambda *views: self._at_render(self.network(StereoViews(*views))), "The depth network"
        )
        self._images: LruCache[int, UInt8[Tensor, "h w 3"]] = LruCache(resident)
        if device.type == "cuda":
            threading.Thread(target=self._warm_up, name="depth network", daemon=True).start()

    @torch.no_grad()
    def _warm_up(self) -> None:
        """Run the network on a black image, so that the first keyframe does not wait a second for
        cuDNN to load and to choose its kernels. Failures are reported at the first use."""
        stream = torch.cuda.Stream(self.device)
        with contextlib.suppress(RuntimeError), torch.cuda.stream(stream):
            black = torch.zeros(1, 3, self.seen.height, self.seen.width, device=self.device)
            one, many = torch.ones(1, device=self.device), (1, MOST_NEIGHBOURS)
            others = black[None].expand(*many, -1, -1, -1)
            lenses = self._intrinsics[:, None].expand(*many, -1)
            poses = torch.eye(4, device=self.device).expand(*many, -1, -1)
            valid = torch.ones(many, dtype=torch.bool, device=self.device)
            views = (black, others, self._intrinsics, lenses, poses, valid, one, 4 * one, 2 * one)
            self.network(StereoViews(*views))

    def estimate(self, tasks: Sequence[DepthTask], progress: Progress = silent) -> list[DenseDepth]:
        """As in the protocol; at most ``MOST_NEIGHBOURS`` are used."""
        found: list[DenseDepth] = []
        for task in tasks:
            if task.neighbours:
                few = task.neighbours[:MOST_NEIGHBOURS]
                found.append(self._search(task.view, few, task.limits))
            else:
                found += self.classical.estimate([task])
            progress(len(found) / len(tasks))
        return found

    @torch.no_grad()
    def _search(
        self, reference: DepthView, others: Sequence[DepthView], limits: Limits | None
    ) -> DenseDepth:
        between = self._range(reference, others, limits)
        depth, confidence, normal = self._recorded(*self._views(reference, others, between))
        (dense,) = dense_depths([(between.typical * depth, confidence)])
        return replace(dense, normal=normal)

    def _range(
        self, reference: DepthView, others: Sequence[DepthView], limits: Limits | None
    ) -> SearchRange:
        grid = reference.inverse_depth
        own = grid[known_cells(grid, reference.information)]
        seen = seen_inverse_depth(reference, (reference, *others), self.working)
        return search_range(seen, own, limits)

    def _views(
        self, reference: DepthView, others: Sequence[DepthView], between: SearchRange
    ) -> tuple[Tensor, ...]:
        """The fields of ``StereoViews``."""
        relative = relative_poses(reference, others)
        images = torch.stack([self._image(v) for v in (reference, *others)])
        images = images.permute(0, 3, 1, 2).float() / 255
        numbers = (between.near, between.far, between.typical)
        bounds = to_device(torch.tensor(numbers, dtype=torch.float32), self.device)
        near, far, typical = bounds.split(1)
        return (
            images[:1],
            images[None, 1:],
            self._intrinsics,
            self._intrinsics[:, None].expand(-1, len(others), -1),
            to_device(torch.from_numpy(relative)[None], self.device, torch.float32),
            torch.ones(1, len(others), dtype=torch.bool, device=self.device),
            near,
            far,
            typical,
        )

    def _image(self, view: DepthView) -> UInt8[Tensor, "h w 3"]:
        """The keyframe's image at the network's size, uploaded at its first use."""
        size = (self.seen.width, self.seen.height)

        def bring() -> Tensor:
            small = cv2.resize(view.image, size, interpolation=cv2.INTER_AREA)
            return upload(small, self.device)

        return self._images.get(view.id, bring)

    def _at_render(self, found: DepthPrediction) -> tuple[Tensor, Tensor, Tensor]:
        """Depth relative to the typical depth, confidence, and normals at the render size."""
        confidence = self.network.calibration.confidence(found.log_scale, found.outlier)
        known = 2 / found.concentration < MOST_ANGLE
        normal = found.normal * known[:, None]
        maps = torch.cat([found.log_depth[:, None], confidence[:, None], normal], 1)
        maps = resampled(maps, (self.render.height, self.render.width))[0]
        length = maps[2:].norm(dim=0)
        unit = maps[2:] / length.clamp_min(1e-6) * (length > 0.5)
        return maps[0].exp(), maps[1].contiguous(), unit.movedim(0, -1).contiguous()


def resampled(maps: Float[Tensor, "b c h w"], size: tuple[int, int]) -> Float[Tensor, "b c h2 w2"]:
    """Bilinear values at another size of the same image; the first map is the logarithm of depth.

    Where two surfaces would be mixed, all values are those of the nearest pixel.
    """
    if tuple(maps.shape[-2:]) == size:
        return maps
    smooth = functional.interpolate(maps, size, mode="bilinear", align_corners=False)
    near = functional.interpolate(maps, size, mode="nearest-exact")
    differ = (smooth[:, :1] - near[:, :1]).abs() > _EDGE
    return torch.where(differ, near, smooth)
