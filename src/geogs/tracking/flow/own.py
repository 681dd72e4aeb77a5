"""The flow operator that is trained for this system (``geogs train flow``)."""

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
    """How the network is run."""

    warm_iterations: int = 4
    """Iterations from a start that is right to a few pixels."""
    coarse_iterations: int = 3
    """The same where a cheaper measurement will do."""
    cold_iterations: int = 8
    """Iterations from what the classical operator finds where nothing is known."""
    min_probability: float = 0.5
    """A cell that is matched with less probability has no weight."""
    max_deviation: float = 2.0
    """A cell whose flow may be off by more pixels has none, either."""
    max_correction: float = 6.0
    """Pixels by which a cell may move away from a warm start more than the median cell does; a
    jump of one period of a pattern that repeats is larger."""
    inflation: float = 100.0
    """Deviation in the adjustment over that of a single match: the errors of a cell are alike in
    all its edges and those of neighbouring cells are alike, too; the adjustment takes them for
    independent. Measured: less trust keeps the polished cells in charge."""
    floor: float = 0.04
    """Deviation in pixels that no match goes below."""
    polish: bool = True
    """Whether the classical operator refines the network's flow."""
    agreement: float = 3.0
    """Standard deviations by which both may differ to be joined; else the network is believed."""
    edges_at_once: int = 64
    """Directed pairs that are in memory together."""


@dataclass(frozen=True)
class OwnImage:
    """An image as the network keeps it, on the device of the grid."""

    features: FlowFeatures
    """Features of one image."""
    classical: Any
    """The classical operator's form of it."""


class OwnFlow:
    """The network on one grid; bfloat16 inside, positions float32.

    The classical operator helps twice. Where nothing is known of a motion it makes the start: on
    patterns that repeat its coarse levels find the right one of many places that look alike, where
    windows of correlation see the nearest. And it polishes: begun at the network's flow it is more
    precise where there is texture, so both are joined by their variances where they agree.
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
        # PyTorch's stubs do not know the memory format.
        self.network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._levels: tuple[PyramidLevel, ...] = ()
        """Pyramid levels of every image, known from the first on."""
        self._encoded = Recorded(self._features, "The flow network")
        self._refined = functools.cache(self._refinement)

    @torch.inference_mode()
    def encode(self, image: UInt8[np.ndarray, "h w 3"]) -> OwnImage:
        check_image_size(image, self.grid.camera)
        pixels = upload(image, self.device)
        source, descriptors, hidden, context = self._encoded(pixels)
        pyramid = DescriptorPyramid(descriptors, self._levels)
        features = FlowFeatures(source, pyramid, hidden, context)
        return OwnImage(features, self.classical.encode(image))

    def _features(self, pixels: UInt8[Tensor, "h w 3"]) -> Maps:
        """Features of an image."""
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
        options, pairs = self.options, len(first)
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
        # One pair is what each frame asks for; of more there are many numbers.
        refined = self._refined(iterations, is_warm, pairs == 1)
        f = _stack([i.features for i in images])
        source, target = (
            to_device(torch.tensor(x), self.device, torch.int32) for x in ([*a, *b], [*b, *a])
        )
        parts = []
        for at in range(0, 2 * pairs, options.edges_at_once):
            part = slice(at, at + options.edges_at_once)
            parts.append(
                refined(
                    f.source, f.pyramid.descriptors, f.hidden, f.context, source[part],
                    target[part], start[part],
                )
            )  # fmt: skip
        pixels, weight = (torch.cat(p).clone() for p in zip(*parts, strict=True))
        if options.polish:
            pixels, weight = self._polished(first, second, pixels, weight, fine, is_warm)
        return FlowMatch(pixels[:pairs], weight[:pairs]), FlowMatch(pixels[pairs:], weight[pairs:])

    def _refinement(self, iterations: int, is_warm: bool, is_recorded: bool) -> Callable[..., Maps]:
        """The function from some edges' starts to their positions and weights.

        Its arguments are the features of images but for the levels, the two images of each edge,
        and the start of each.
        """

        def work(
            source: Tensor, descriptors: Tensor, hidden: Tensor, context: Tensor,
            first: Tensor, second: Tensor, start: Tensor,
        ) -> Maps:  # fmt: skip
            pyramid = DescriptorPyramid(descriptors, self._levels)
            features = FlowFeatures(source, pyramid, hidden, context)
            with self._autocast():
                *_, last = self.network.iterate(features, Edges(first, second), start, iterations)
            return last.pixels, self._weight(last, start if is_warm else None)

        return Recorded(work, "The flow network") if is_recorded else work

    def _cold_start(
        self, first: Sequence[OwnImage], second: Sequence[OwnImage]
    ) -> Float[Tensor, "d p 2"]:
        """The classical flow of both directions, its gaps filled; no motion where it has none."""
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
        """The network's flow joined with the classical flow that begins there.

        From a cold start what the classical flow does not confirm has no weight: where neither
        knows the motion, as in front of a car, the network is confident of what is merely alike.
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
        """Inverse variance of matched cells; none where a match is unlikely or leaves the image,
        or goes elsewhere than the others from a warm start."""
        options, error = self.options, estimate.error
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


def _stack(parts: Sequence[FlowFeatures]) -> FlowFeatures:
    """Features of several images as one."""
    if len(parts) == 1:
        return parts[0]
    descriptors = torch.cat([p.pyramid.descriptors for p in parts])
    return FlowFeatures(
        torch.cat([p.source for p in parts]),
        DescriptorPyramid(descriptors, parts[0].pyramid.levels),
        torch.cat([p.hidden for p in parts]),
        torch.cat([p.context for p in parts]),
    )
