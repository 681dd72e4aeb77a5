"""The fixed validation set, rooms and textures that training never uses, and the scores on it."""

from dataclasses import asdict, dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from geogs.tracking.flow.cell_texture import MIN_STRUCTURE
from geogs.tracking.flow.own_network import FlowNetwork
from geogs_synth.clips.room_options import SCENE_KINDS, only_scene
from geogs_synth.clips.sampler import RoomSampler
from geogs_synth.textures.pyramids import TextureBank
from geogs_train.flow.flow_loss import run_network
from geogs_train.flow.flow_options import FlowTraining
from geogs_train.flow.flow_pairs import FlowBatch, flow_batch
from geogs_train.flow.starts import StartOptions

SEED = 2718


@dataclass(frozen=True)
class FlowScores:
    """Errors over visible pixels, in pixels unless stated."""

    dense: float
    """Mean end-point error of every pixel."""
    epe: float
    """Mean end-point error of the cells."""
    median: float
    """Median over the cells."""
    textureless: float
    """Mean over cells without texture."""
    large: float
    """Mean over cells that move by more than 16 pixels."""
    outliers: float
    """Fraction of cells with errors above a pixel."""
    within: float
    """Fraction of cells with errors in x and y within two predicted standard deviations."""
    within_visible_large: float
    """The same over cells that move by more than 16 pixels."""
    sure_share: float
    """Fraction of cells with a predicted standard deviation below half a pixel."""
    sure_error: float
    """Mean error of those."""

    def line(self) -> str:
        """Format on one line."""
        return "  ".join(f"{name} {value:.3f}" for name, value in asdict(self).items())


@dataclass(frozen=True)
class CellErrors:
    """Errors of flow on cells, one row a cell."""

    error: Float[Tensor, "n 2"]
    """Pixels."""
    deviation: Float[Tensor, "n 2"]
    """Predicted standard deviation, pixels."""
    motion: Float[Tensor, "n"]
    """Length of the true flow, pixels."""
    textured: Bool[Tensor, "n"]
    dense: Float[Tensor, "m"]
    """End-point errors of all pixels."""


@dataclass(frozen=True)
class SceneScores:
    """Scores on the kinds of scenes in a network's training."""

    usual: FlowScores
    others: dict[str, FlowScores]
    """Scores by the names of :class:`SceneWeights`."""

    def line(self) -> str:
        """Format on a line for each kind."""
        rows = {"usual": self.usual, **self.others}
        return "\n".join(f"{name:8} {scores.line()}" for name, scores in rows.items())


class SceneValidation:
    """One validation set for each kind of scene; always with the usual one."""

    def __init__(self, options: FlowTraining, device: torch.device, batches: int) -> None:
        self._usual = Validation(options, device, batches)
        weights = options.rooms.scenes
        few = max(1, batches // 2)
        self._others = {
            name: Validation(options, device, few, name, self._usual.bank)
            for name in SCENE_KINDS[1:]
            if getattr(weights, name) > 0
        }

    def score(self, network: FlowNetwork) -> SceneScores:
        """Scores of a network."""
        others = {name: v.score(network) for name, v in self._others.items()}
        return SceneScores(self._usual.score(network), others)


class Validation:
    """Batches of unseen scenes of one kind, rendered on demand."""

    def __init__(
        self,
        options: FlowTraining,
        device: torch.device,
        batches: int = 8,
        scene: str = "usual",
        bank: TextureBank | None = None,
    ) -> None:
        """``bank`` may be that of another set."""
        rooms = replace(options.rooms, views=2, validation=True, scenes=only_scene(scene))
        self._rooms = RoomSampler(rooms, device, SEED, bank)
        self.bank = self._rooms.bank
        self.batches = batches
        self._options = options

    def batch(self, number: int, starts: StartOptions | None = None) -> FlowBatch:
        """Directed pairs of a batch, with the starts of the training unless others are given."""
        clips = self._rooms.sample(number, self._options.batch)
        generator = torch.Generator(self._rooms.device).manual_seed(SEED + number)
        return flow_batch(clips, starts or StartOptions(), generator)

    @torch.no_grad()
    def score(self, network: FlowNetwork) -> FlowScores:
        """Scores of a network."""
        parts = []
        for number in range(self.batches):
            batch = self.batch(number)
            _, estimates, dense = run_network(network, batch, self._options.iterations)
            deviation = estimates[-1].error.variance().sqrt()
            parts.append(cell_errors(batch, estimates[-1].pixels, deviation, dense))
        return summarise(parts)


def cell_errors(
    batch: FlowBatch, pixels: torch.Tensor, deviation: torch.Tensor, dense: torch.Tensor
) -> CellErrors:
    """Errors on the visible cells (and pixels) of a batch, given positions and dense flow."""
    truth = batch.at_cells(batch.truth)
    visible = batch.at_cells(batch.visible)
    flow = batch.flow
    textured = batch.at_cells(has_texture(batch.images))[batch.edges.first.long()]
    return CellErrors(
        error=(truth - pixels)[visible],
        deviation=deviation[visible],
        motion=batch.at_cells(flow).norm(dim=-1)[visible],
        textured=textured[visible],
        dense=(flow - dense).norm(dim=-1)[batch.visible],
    )


def summarise(parts: list[CellErrors]) -> FlowScores:
    """Scores over all cells of several batches."""
    rows = zip(*(vars(part).values() for part in parts), strict=True)
    error, deviation, motion, textured, dense = map(torch.cat, rows)
    length = error.norm(dim=-1)
    inside = (error.abs() < 2 * deviation).float().mean(-1)
    large = motion > 16
    sure = deviation.amax(-1) < 0.5
    return FlowScores(
        dense=float(dense.mean()),
        epe=float(length.mean()),
        median=float(length.median()),
        textureless=_mean(length, ~textured),
        large=_mean(length, large),
        outliers=float((length > 1).float().mean()),
        within=float(inside.mean()),
        within_visible_large=_mean(inside, large),
        sure_share=float(sure.float().mean()),
        sure_error=_mean(length, sure),
    )


def has_texture(images: Float[Tensor, "n 3 h w"]) -> Bool[Tensor, "n h w"]:
    """Mask where the structure tensor over 9 x 9 pixels has no small eigenvalue, as in tracking."""
    weights = images.new_tensor([0.299, 0.587, 0.114]) * 255
    grey = (images * weights[:, None, None]).sum(1, keepdim=True)
    kernel = images.new_tensor([[-1, 0, 1], [-2, 0, 2], [-1, 0, 1]]) / 8
    padded = functional.pad(grey, (1, 1, 1, 1), mode="replicate")
    gx, gy = (functional.conv2d(padded, k[None, None]) for k in (kernel, kernel.mT))
    xx, yy, xy = (functional.avg_pool2d(p, 9, 1, 4)[:, 0] for p in (gx * gx, gy * gy, gx * gy))
    smaller = (xx + yy) / 2 - (((xx - yy) / 2) ** 2 + xy * xy).sqrt()
    return smaller > MIN_STRUCTURE


def _mean(values: Tensor, chosen: Bool[Tensor, "n"]) -> float:
    return float(values[chosen].mean()) if bool(chosen.any()) else float("nan")
