"""Keyframe depths by the network, on the CPU or a GPU, alone or joined with the classical search.

Joined depths are a mean where both searches agree, elsewhere the likelier one.
"""

import contextlib
import math
import threading
from collections.abc import Sequence
from dataclasses import replace

import cv2
import torch
from jaxtyping import Bool, Float, UInt8
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
REACH = 0.03
"""Relative distance within which two depths are of one surface, and averaged."""
MEAN, CHOICE = (45.0, 0.63, 0.16, 0.35), (12.0, 0.55, 0.52, 0.5)
"""Coefficients of two logits: of the network's weight in the mean, and of the chance that its depth
is the right one. They multiply the images' vote, the logit of the search's confidence (subtracted)
and that of the network's; the last is a constant. MEAN minimises the mean of
log(1 + (error / 0.5 %)²), CHOICE is a logistic regression, on eight rooms and streets."""
AGREE, DIFFER = (0.74, 0.53, 0.28), (0.35, 0.17, 0.41, -0.54)
"""Coefficients of the logit of the chance that the result is right to 2 %. Where both agree: of the
larger and the smaller of their logits, and a constant; where not: of the logits of the chosen depth
and of the other, of the size of the choice's logit, and a constant. Logistic regressions as well,
the first on eight keyframes of four rooms."""
BOUND = 0.02
"""Least distance of a confidence from 0 and 1 where its logit is taken."""


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
            one = torch.ones(1, device=self.device)
            many = (1, MOST_NEIGHBOURS)
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
        grid = reference.inverse_depth
        own = grid[known_cells(grid, reference.information)]
        seen = seen_inverse_depth(reference, (reference, *others), self.working)
        between = search_range(seen, own, limits)
        depth, confidence, normal = self._recorded(*self._views(reference, others, between))
        (dense,) = dense_depths([(between.typical * depth, confidence)])
        return replace(dense, normal=normal)

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


class JointDepthEngine(AlternativeSearch):
    """Searches with both engines and joins their depths; normals are the network's."""

    def __init__(self, network: DepthEngine, classical: DepthEngine) -> None:
        super().__init__(classical)
        self.network = network

    def estimate(self, tasks: Sequence[DepthTask], progress: Progress = silent) -> list[DenseDepth]:
        """As in the protocol."""
        learned = self.network.estimate(tasks, lambda done: progress(0.5 * done))
        searched = self.classical.estimate(tasks, lambda done: progress(0.5 + 0.5 * done))
        return [
            self._joined(task, s, n) if task.neighbours else n
            for task, s, n in zip(tasks, searched, learned, strict=True)
        ]

    def _joined(self, task: DepthTask, searched: DenseDepth, learned: DenseDepth) -> DenseDepth:
        depths = torch.stack([searched.depth, learned.depth])
        same = agreement(searched, learned)
        costs = self.classical.photo_costs(task.view, task.neighbours, depths, same)
        return joined(searched, learned, costs[0] - costs[1])


def agreement(first: DenseDepth, second: DenseDepth) -> Bool[Tensor, "h w"]:
    """Whether both depths of each pixel are of one surface."""
    return (first.depth.log() - second.depth.log()).abs() < REACH


def joined(first: DenseDepth, second: DenseDepth, vote: Float[Tensor, "h w"]) -> DenseDepth:
    """Join two depths; normals are the second's.

    Where they agree the result is a mean of their logarithms, elsewhere the likelier one. Both
    depend on the confidences and the images' ``vote``: the first one's ``photo_costs`` minus the
    second's.
    """
    logs = torch.stack([first.depth, second.depth]).log()
    confidence = torch.stack([first.confidence, second.confidence])
    logit = confidence.clamp(BOUND, 1 - BOUND).logit()
    weight, choice = (speaks_for_second(by, vote, logit) for by in (MEAN, CHOICE))
    mean = torch.lerp(logs[0], logs[1], weight.sigmoid())
    agree = agreement(first, second)
    take = choice < 0
    depth = torch.where(agree, mean, torch.where(take, logs[0], logs[1])).exp()
    chosen, other = torch.where(take, logit, logit.flip(0))
    both = AGREE[0] * logit.amax(0) + AGREE[1] * logit.amin(0) + AGREE[2]
    alone = DIFFER[0] * chosen + DIFFER[1] * other + DIFFER[2] * choice.abs() + DIFFER[3]
    (found,) = dense_depths([(depth, torch.where(agree, both, alone).sigmoid())])
    return replace(found, normal=second.normal)


def speaks_for_second(
    by: tuple[float, float, float, float] | Float[Tensor, "4"],
    vote: Float[Tensor, "*n"],
    logit: Float[Tensor, "2 *n"],
) -> Float[Tensor, "*n"]:
    """Logit in favour of the second of two depths, given the logits of their confidences."""
    return by[0] * vote - by[1] * logit[0] + by[2] * logit[1] + by[3]
