"""What a monocular prior brings to tracking, and what a bad one costs.

    python benchmarks/priors.py [--frames 80] [--long-edge 320] [--rooms 2] [--kind scale_free]

Rooms whose walls are painted in one colour are tracked without a prior, with one that errs as
networks do, and with one that is wrong by a factor of two and more in a third of each image (see
``geogs.synth.prior``). Depth errors are relative, over the tracker's grid of all keyframes but the
first and last, after the similarity that aligns the trajectory.
"""

import argparse
import dataclasses
import json
import time
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from geogs.config import PriorConfig
from geogs.geometry.camera import Camera
from geogs.geometry.umeyama import umeyama
from geogs.loop.global_bundle import global_bundle
from geogs.priors.base import DepthKind, MonocularPrior
from geogs.synth.prior import BAD, PLAUSIBLE, DegradedPrior
from geogs.synth.raycast import Raycaster, View
from geogs.synth.room import make_room, with_bare_walls
from geogs.synth.trajectory import handheld_trajectory
from geogs.tracking.flow.texture import MIN_STRUCTURE, cell_structure
from geogs.tracking.grid import OFFSET, STRIDE
from geogs.tracking.tracker import Tracker
from geogs.types import Frame


@dataclass(frozen=True)
class Walk:
    """Views along a path."""

    camera: Camera
    views: list[View]
    T_wc: np.ndarray


@dataclass(frozen=True)
class Score:
    """How far poses and depths are from the truth."""

    ate_cm: float
    """Root mean square over the keyframes."""
    median: float
    """Relative depth error."""
    mean: float
    bare_median: float
    """Where the image has no texture."""
    bare_mean: float
    textured_mean: float
    bare_share: float


def walk(seed: int, frames: int, long_edge: int, bare: bool = True) -> Walk:
    """A hand-held path through a room."""
    camera = Camera(272.0, 272.0, 159.5, 119.5, 320, 240).with_long_edge(long_edge)
    scene = with_bare_walls(make_room(seed)) if bare else make_room(seed)
    T_wc = handheld_trajectory(scene, frames)
    caster = Raycaster(scene)
    return Walk(camera, [caster.render(camera, T) for T in T_wc], T_wc)


def track(walk: Walk, prior: MonocularPrior | None, config: PriorConfig) -> Tracker:
    """A tracker that has seen all of it."""
    tracker = Tracker(walk.camera, prior=prior, prior_config=config)
    for n, view in enumerate(walk.views):
        tracker.track(Frame(n, n / 30, view.image))
    tracker.finish()
    return tracker


def score(tracker: Tracker, walk: Walk) -> Score:
    """Errors of a tracker's keyframes."""
    keyframes = [tracker.keyframe(k) for k in tracker.keyframe_ids]
    centres = np.stack([torch.linalg.inv(k.T_cw)[:3, 3].numpy() for k in keyframes])
    truth = walk.T_wc[[k.frame_index for k in keyframes], :3, 3]
    x, y = torch.from_numpy(centres), torch.from_numpy(truth)
    scale, R, t = umeyama(x, y)
    ate = 100 * float((scale * x @ R.T + t - y).square().sum(1).mean().sqrt())
    errors, bare = [], []
    for k in keyframes[1:-1]:
        depth = walk.views[k.frame_index].depth[OFFSET:-3:STRIDE, OFFSET:-3:STRIDE]
        errors.append(np.abs(float(scale) / k.inverse_depth.numpy() / depth - 1).ravel())
        grey = cv2.cvtColor(k.image, cv2.COLOR_RGB2GRAY)
        bare.append(cell_structure(grey) < MIN_STRUCTURE)
    error, where = np.concatenate(errors), np.concatenate(bare)
    return Score(
        ate, float(np.median(error)), float(error.mean()), float(np.median(error[where])),
        float(error[where].mean()), float(error[~where].mean()), float(where.mean()),
    )  # fmt: skip


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=80)
    parser.add_argument("--long-edge", type=int, default=320)
    parser.add_argument("--rooms", type=int, default=2)
    parser.add_argument("--textured", action="store_true", help="leave the walls as they are")
    parser.add_argument("--global", action="store_true", dest="all", help="adjust all at the end")
    parser.add_argument("--kind", choices=[k.value for k in DepthKind], default="scale_free")
    parser.add_argument("--set", nargs="*", default=[], help="name=value of PriorConfig")
    args = parser.parse_args()
    torch.set_num_threads(1)  # as the system works; our own threads use the cores
    changes = {k: json.loads(v) for k, v in (item.split("=") for item in args.set)}
    config = dataclasses.replace(PriorConfig(), **changes)
    columns = (
        "room",
        "prior",
        "ATE cm",
        "depth median",
        "mean",
        "bare median",
        "mean",
        "textured",
        "s",
    )
    print("| " + " | ".join(columns) + " |")
    print("|---" * len(columns) + "|")
    for seed in range(args.rooms):
        seen = walk(seed, args.frames, args.long_edge, not args.textured)
        for name, errors in (("none", None), ("good", PLAUSIBLE), ("bad", BAD)):
            kind = DepthKind(args.kind)
            prior = None if errors is None else DegradedPrior(seen.views, errors, kind)
            start = time.perf_counter()
            tracker = track(seen, prior, config)
            if args.all:
                global_bundle(tracker)
            seconds, s = time.perf_counter() - start, score(tracker, seen)
            print(
                f"| {seed} ({s.bare_share:.0%} bare) | {name} | {s.ate_cm:.3f} | {s.median:.2%} "
                f"| {s.mean:.2%} | {s.bare_median:.2%} | {s.bare_mean:.2%} | {s.textured_mean:.2%} "
                f"| {seconds:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
