"""The flow operator with a network trained for this system (``geogs train flow``)."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from geogs.gpu.recorded import Maps, Recorded
from geogs.gpu.transfer import to_device, upload
from geogs.threads import opencv_on_one_thread
from geogs.tracking.flow.filled import filled_positions
from geogs.tracking.flow.flow_operator import FlowOperator, Memories, check_image_size
from geogs.tracking.flow.lookup import DescriptorPyramid, Edges, PyramidLevel
from geogs.tracking.flow.own_network import FlowEstimate, FlowFeatures, load_flow_network
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid


@dataclass(frozen=True)
class OwnFlowOptions:
    """Options of running the network."""

    warm_iterations: int = 4
    """Iterations from a start that is right to a few pixels."""
    coarse_iterations: int = 3
    """Iterations of a cheaper measurement from such a start."""
    cold_iterations: int = 8
    """Iterations from the classical operator's flow, where there is no start."""
    min_probability: float = 0.5
    """Least probability of a match for a cell to have any weight."""
    max_deviation: float = 2.0
    """Largest deviation in pixels of a cell's flow for it to have any weight."""
    max_correction: float = 6.0
    """Largest motion in pixels of a cell from a warm start relative to the median cell's; a jump by
    one period of a repetitive pattern is larger."""
    inflation: float = 100.0
    """Deviation in the adjustment over that of a single match: errors of a cell are correlated over
    its edges and with those of neighbours, but the adjustment assumes them to be independent.
    Measured: with larger deviations the refined cells dominate."""
    floor: float = 0.04
    """Least deviation of a match, pixels."""
    polish: bool = True
    """Whether the classical operator refines the network's flow."""
    agreement: float = 3.0
    """Largest difference of the two, in standard deviations, for averaging; else the network's flow
    is used."""
    edges_at_once: int = 64
    """Directed pairs that are in memory together."""


@dataclass(frozen=True)
class OwnImage:
    """An image encoded by the network, on the device of the grid."""

    features: Maps
    """Those of :class:`FlowFeatures`, without the levels of the pyramid."""
    classical: Any
    """The image encoded by the classical operator."""


class OwnFlow:
    """The network on one grid; bfloat16 inside, positions float32.

    The classical operator is used twice. It gives the start of unknown motions: on repetitive
    patterns its coarse levels find the right one of many similar positions, while correlation
    windows find the nearest. And it refines: started from the network's flow it is more precise on
    texture, so both are averaged by their variances where they agree.
    """

    def __init__(
        self,
        grid: SampleGrid,
        weights: Path,
        classical: FlowOperator,
        options: OwnFlowOptions | None = None,
    ) -> None:
        opencv_on_one_thread()
        self.grid = grid
        self.classical = classical
        self.options = options or OwnFlowOptions()
        self.device = torch.device(grid.device)
        network = load_flow_network(weights)
        network.to(self.device)
        # PyTorch's stubs lack the memory format.
        self.network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._levels: tuple[PyramidLevel, ...] = ()
        """Pyramid levels of every image, set by the first one."""
        self._encoded = Recorded(self._features, "The flow network")
        self._refined = functools.cache(self._refinement)

    @torch.inference_mode()
    def encode(self, image: UInt8[np.ndarray, "h w 3"]) -> OwnImage:
        check_image_size(image, self.grid.camera)
        features = self._encoded(upload(image, self.device))
        return OwnImage(features, self.classical.encode(image))

    def _features(self, pixels: UInt8[Tensor, "h w 3"]) -> Maps:
        """Compute the features of an image."""
        with self._autocast():
            found = self.network.encode(pixels.permute(2, 0, 1)[None].float() / 255)
        self._levels = found.pyramid.levels
        return found.source, found.pyramid.descriptors, found.hidden, found.context

    def texture(self, encoded: OwnImage) -> float:
        return self.classical.texture(encoded.classical)

    def grey(self, encoded: OwnImage) -> Float[Tensor, "h w"]:
        return self.classical.grey(encoded.classical)

    @torch.inference_mode()
    def measure(
        self,
        first: Sequence[OwnImage],
        second: Sequence[OwnImage],
        forward: Float[Tensor, "e p 2"] | None = None,
        backward: Float[Tensor, "e p 2"] | None = None,
        fine: bool = True,
        memory: Memories | None = None,
    ) -> tuple[FlowMatch, FlowMatch]:
        options = self.options
        pairs = len(first)
        images = list({id(i): i for i in (*first, *second)}.values())
        slot = {id(image): n for n, image in enumerate(images)}
        a, b = ([slot[id(i)] for i in side] for side in (first, second))
        is_warm = forward is not None and backward is not None
        if forward is None or backward is None:
            start = self._cold_start(first, second)
            iterations = options.cold_iterations
        else:
            start = torch.cat([forward, backward]).float()
            iterations = options.warm_iterations if fine else options.coarse_iterations
        # Each frame measures one pair; larger numbers of pairs vary.
        refined = self._refined(iterations, is_warm, pairs == 1)
        features = [torch.cat(m) for m in zip(*(i.features for i in images), strict=True)]
        source, target = (
            to_device(torch.tensor(x), self.device, torch.int32) for x in ([*a, *b], [*b, *a])
        )
        parts = []
        for at in range(0, 2 * pairs, options.edges_at_once):
            part = slice(at, at + options.edges_at_once)
            parts.append(refined(*features, source[part], target[part], start[part]))
        pixels, weight = (torch.cat(p).clone() for p in zip(*parts, strict=True))
        if options.polish:
            pixels, weight = self._polished(first, second, pixels, weight, fine, is_warm)
        return FlowMatch(pixels[:pairs], weight[:pairs]), FlowMatch(pixels[pairs:], weight[pairs:])

    def _refinement(self, iterations: int, is_warm: bool, is_recorded: bool) -> Callable[..., Maps]:
        """Return the function from some edges' starts to their positions and weights.

        Its arguments are the features of images without the levels, the two images of each edge,
        and the start of each.
        """

        def work(*given: Tensor) -> Maps:
            source, descriptors, hidden, context, first, second, start = given
            pyramid = DescriptorPyramid(descriptors, self._levels)
            features = FlowFeatures(source, pyramid, hidden, context)
            with self._autocast():
                *_, last = self.network.iterate(features, Edges(first, second), start, iterations)
            return last.pixels, self._weight(last, start if is_warm else None)

        return Recorded(work, "The flow network") if is_recorded else work

    def _cold_start(
        self, first: Sequence[OwnImage], second: Sequence[OwnImage]
    ) -> Float[Tensor, "d p 2"]:
        """Return the classical flow of both directions with gaps filled; zero without any match."""
        a, b = ([i.classical for i in side] for side in (first, second))
        matches = self.classical.measure(a, b, fine=False)
        starts = []
        for match in matches:
            for pixels, weight in zip(match.pixels, match.weight, strict=True):
                found = FlowMatch(pixels[None], weight[None])
                known = bool((weight > 0).any())
                starts.append(filled_positions(self.grid, found) if known else self.grid.pixels)
        return torch.stack(starts)

    def _polished(
        self,
        first: Sequence[OwnImage],
        second: Sequence[OwnImage],
        pixels: Float[Tensor, "d p 2"],
        weight: Float[Tensor, "d p 2"],
        fine: bool,
        is_warm: bool,
    ) -> tuple[Float[Tensor, "d p 2"], Float[Tensor, "d p 2"]]:
        """Average the network's flow with the classical flow that starts from it.

        From a cold start, flow not confirmed by the classical flow has no weight: where neither
        finds the motion, as in front of a car, the network is confident of mere similarity.
        """
        a, b = ([i.classical for i in side] for side in (first, second))
        matches = self.classical.measure(a, b, pixels[: len(a)], pixels[len(a) :], fine)
        theirs = torch.cat([m.pixels for m in matches])
        certain = torch.cat([m.weight for m in matches])
        both = ((weight > 0) & (certain > 0)).all(-1, keepdim=True)
        variance = 1 / weight.clamp(min=1e-9) + 1 / certain.clamp(min=1e-9)
        residual = ((theirs - pixels).square() / variance).amax(-1, keepdim=True)
        join = both & (residual < self.options.agreement**2)
        total = weight + certain
        mean = (weight * pixels + certain * theirs) / total.clamp(min=1e-9)
        alone = weight if is_warm else torch.zeros_like(weight)
        return torch.where(join, mean, pixels), torch.where(join, total, alone)

    def _weight(
        self, estimate: FlowEstimate, start: Float[Tensor, "e p 2"] | None
    ) -> Float[Tensor, "e p 2"]:
        """Return the inverse variance of matched cells; zero where a match is unlikely, outside the
        image, or moves differently from the others after a warm start."""
        options = self.options
        error = estimate.error
        deviation = 2**0.5 * error.log_scale.exp().amax(-1)
        good = (deviation < options.max_deviation) & self.grid.inside(estimate.pixels)
        good &= error.logit[..., 0].sigmoid() > options.min_probability
        if start is not None:
            moved = (estimate.pixels - start).masked_fill(~good[..., None], torch.nan)
            correction = (moved - moved.nanmedian(1, keepdim=True).values).norm(dim=-1)
            good &= correction < options.max_correction
        weight = error.weight(options.floor) / options.inflation**2
        return torch.where(good[..., None], weight, 0.0)

    def _autocast(self) -> torch.autocast:
        return torch.autocast(self.device.type, torch.bfloat16)
