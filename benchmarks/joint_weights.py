"""Fit what the joint depth engine goes by: the constants of geogs/depth/network/joint.py.

    python benchmarks/joint_weights.py SEQUENCE... [--long-edge 400] [--device auto]

Each SEQUENCE is a folder of geogs synth with exact depth and a camera that neither bends nor reads
rows in turn (--flaws.noise, jpeg, exposure, gain-drift and vignetting are fine). It is run as
geogs run does, without training the map, and of each keyframe the depths of both engines are kept
before they are joined. The
constants are printed that suit all sequences; then, of each, how many per cent of its pixels are
within 0.5, 1, 2 and 5 % of the truth by the search, by the network, joined as it is now, and joined
by constants fitted on the other sequences (of one alone, on itself).
"""

import argparse
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, softplus

import geogs
from geogs.config import InputConfig, preset
from geogs.depth.depth_engine import DepthTask
from geogs.depth.depth_view import DenseDepth
from geogs.depth.network import joint
from geogs.gpu.early_start import is_gpu
from geogs.io.sources.sniff import open_source

DRAWN = 2000
"""Pixels of each keyframe."""
SURE = 0.7
"""Confidence of the search above which a pixel says how long the map's unit is."""
FINE = 0.005
"""Error above which the fit of the mean asks less of a pixel."""
LIMITS = (0.005, 0.01, 0.02, 0.05)

Constants = tuple[float, ...]


@dataclass(frozen=True)
class Pixels:
    """Pixels of a sequence of which the true depth is known."""

    error: Tensor
    """(2, n) logarithm of the search's and of the network's depth over the true one."""
    logit: Tensor
    """(2, n) of the confidences."""
    vote: Tensor
    """(n) the search's photometric cost less the network's."""

    @property
    def same(self) -> Tensor:
        """Where both are of one surface."""
        return (self.error[0] - self.error[1]).abs() < joint.REACH

    def of(self, some: Tensor) -> "Pixels":
        """Some of them."""
        return Pixels(self.error[:, some], self.logit[:, some], self.vote[some])

    def joined(self, mean: Constants, choice: Constants) -> Tensor:
        """(n) errors of the joined depth."""
        weight, is_second = self.speaks(mean).sigmoid(), self.speaks(choice) >= 0
        chosen = torch.where(is_second, self.error[1], self.error[0])
        return torch.where(self.same, torch.lerp(*self.error, weight), chosen)

    def speaks(self, by: Constants | Tensor) -> Tensor:
        """(n) the logit of what speaks for the network."""
        return joint.speaks_for_second(by, self.vote, self.logit)


def seen(sequence: Path, long_edge: int, device: str) -> Pixels:
    """Pixels of the keyframes of a run."""
    inputs = InputConfig(long_edge=long_edge, depth="auto")
    truth = {f.timestamp: f.depth.metres() for f in open_source(sequence, inputs) if f.depth}
    kept: dict[int, tuple[DenseDepth, DenseDepth, Tensor]] = {}
    config = preset("default", is_gpu(device))
    depth = replace(config.mapping.depth, engine="joint")
    mapping = replace(config.mapping, depth=depth, render_long_edge=long_edge, final_iterations=1)
    config = replace(config, input=replace(inputs, depth="none"), mapping=mapping)
    with tempfile.TemporaryDirectory() as folder, _keeping(kept):
        result = geogs.run(sequence, config, folder, device)
        times = {k.id: k.timestamp for k in result.scene.segments.main.segment.keyframes}
    maps = [(*kept[i], torch.from_numpy(truth[times[i]])) for i in sorted(kept)]
    sure = [(s.confidence.cpu() > SURE) & (true > 0) for s, _, _, true in maps]
    ratios = [(m[3] / m[0].depth.cpu())[some].median() for m, some in zip(maps, sure, strict=True)]
    unit = torch.stack(ratios).nanmedian()
    random, parts = torch.Generator().manual_seed(0), []
    for searched, learned, vote, true in maps:
        known = (true > 0).flatten().nonzero()[:, 0]
        some = known[torch.randperm(len(known), generator=random)[:DRAWN]]

        def of(values: Tensor, some: Tensor = some) -> Tensor:
            return values.cpu().flatten()[some].double()

        both, log_true = (searched, learned), (of(true) / unit).log()
        error = torch.stack([of(d.depth).log() - log_true for d in both])
        logit = torch.stack(
            [of(d.confidence).clamp(joint.BOUND, 1 - joint.BOUND).logit() for d in both]
        )
        parts.append(Pixels(error, logit, of(vote)))
    return Pixels(
        torch.cat([p.error for p in parts], 1),
        torch.cat([p.logit for p in parts], 1),
        torch.cat([p.vote for p in parts]),
    )


@contextmanager
def _keeping(kept: dict[int, tuple[DenseDepth, DenseDepth, Tensor]]) -> Iterator[None]:
    """Meanwhile the engine's two depths and the vote are kept, by keyframe."""
    of_engine, of_two, id = joint.JointDepthEngine._joined, joint.joined, -1

    def of_task(engine: Any, task: DepthTask, *depths: DenseDepth) -> DenseDepth:
        nonlocal id
        id = task.view.id
        return of_engine(engine, task, *depths)

    def join(first: DenseDepth, second: DenseDepth, vote: Tensor) -> DenseDepth:
        kept[id] = first, second, vote
        return of_two(first, second, vote)

    try:
        joint.JointDepthEngine._joined, joint.joined = of_task, join
        yield
    finally:
        joint.JointDepthEngine._joined, joint.joined = of_engine, of_two


def least(count: int, loss: Callable[[Tensor], Tensor]) -> Constants:
    """The constants of the least loss."""
    found = torch.zeros(count, dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.LBFGS([found], max_iter=100)

    def closure() -> Tensor:
        optimiser.zero_grad()
        value = loss(found)
        value.backward()
        return value

    optimiser.step(closure)
    return tuple(found.tolist())


def fitted_mean(parts: Sequence[Pixels]) -> Constants:
    """By which depths of one surface are averaged; all sequences count alike."""
    agreeing = [p.of(p.same) for p in parts]

    def loss(c: Tensor) -> Tensor:
        errors = (torch.lerp(*p.error, p.speaks(c).sigmoid()) for p in agreeing)
        return sum(((error / FINE) ** 2).log1p().mean() for error in errors)

    return least(4, loss)


def fitted_choice(parts: Sequence[Pixels]) -> Constants:
    """By which one of two depths is taken, where one of them is of the true surface."""
    terms = []
    for p in parts:
        differing = p.of(~p.same & (p.error.abs().amin(0) < joint.REACH))
        off = differing.error.abs()
        terms.append((differing, (off[1] < off[0]).double()))
    entropy = binary_cross_entropy_with_logits
    return least(4, lambda c: sum(entropy(p.speaks(c), y) for p, y in terms))


def fitted_confidence(
    parts: Sequence[Pixels], mean: Constants, choice: Constants
) -> tuple[Constants, Constants]:
    """By which the chance is told that the result is right, where both agree and elsewhere."""
    agree, differ = [], []
    for p in parts:
        right, speaks = (p.joined(mean, choice).abs() < 0.02).double(), p.speaks(choice)
        one = torch.ones_like(speaks)
        both = torch.stack([p.logit.amax(0), p.logit.amin(0), one], 1)
        ordered = torch.where(speaks >= 0, p.logit.flip(0), p.logit)
        alone = torch.stack([*ordered, speaks.abs(), one], 1)
        agree.append((both[p.same], right[p.same]))
        differ.append((alone[~p.same], right[~p.same]))

    def of(terms: list[tuple[Tensor, Tensor]]) -> Constants:
        def loss(c: Tensor) -> Tensor:
            return sum((softplus(t @ c) - y * (t @ c)).mean() for t, y in terms)

        return least(terms[0][0].shape[1], loss)

    return of(agree), of(differ)


def shares(error: Tensor) -> str:
    """Per cent of the pixels within each limit."""
    within = [float((error.abs() < limit).double().mean()) for limit in LIMITS]
    return " / ".join(f"{100 * share:4.1f}" for share in within)


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequences", type=Path, nargs="+")
    parser.add_argument("--long-edge", type=int, default=400)
    parser.add_argument("--device", default="auto")
    arguments = parser.parse_args()
    found = {s.name: seen(s, arguments.long_edge, arguments.device) for s in arguments.sequences}
    every = list(found.values())
    mean, choice = fitted_mean(every), fitted_choice(every)
    agree, differ = fitted_confidence(every, mean, choice)
    names = {"MEAN": mean, "CHOICE": choice, "AGREE": agree, "DIFFER": differ}
    for name, constants in names.items():
        print(f"{name:7s}", " ".join(f"{c:.2f}" for c in constants))
    for name, pixels in found.items():
        others = [p for other, p in found.items() if other != name] or every
        print(f"{name}: {100 * float(pixels.same.double().mean()):.0f} % agree")
        rows = {
            "search": pixels.error[0],
            "network": pixels.error[1],
            "joined": pixels.joined(joint.MEAN, joint.CHOICE),
            "by others": pixels.joined(fitted_mean(others), fitted_choice(others)),
        }
        for row, error in rows.items():
            print(f"  {row:10s}{shares(error)}")


if __name__ == "__main__":
    main()
