"""Gain from a monocular prior in tracking and in the map, and loss from a bad one.

    python benchmarks/priors.py [--frames 80] [--long-edge 320] [--rooms 2] [--kind scale_free]
    python benchmarks/priors.py --map [--frames 60] [--rooms 1]

Rooms with walls of one colour are tracked without a prior, with one that has errors like a
network's, and with one that is wrong by a factor of two and more in a third of each image (see
``degraded_prior.py``). Depth errors are relative, over the tracker's grid of all keyframes but the
first and last, after the similarity that aligns the trajectory. With ``--map`` the whole system
runs, and the errors are those of the depth and normals of the map rendered from all keyframes.
"""

import argparse
import dataclasses
import json
import time
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from degraded_prior import BAD, PATCHY, PLAUSIBLE, DegradedPrior, with_bare_walls
from geogs.config import Config, MappingConfig, PriorConfig
from geogs.geometry.camera import Camera
from geogs.loop.global_bundle import global_bundle
from geogs.priors.monocular_prior import DepthKind, MonocularPrior
from geogs.slam import Slam
from geogs.tracking.flow.cell_texture import MIN_STRUCTURE, cell_structure, common_tensor
from geogs.tracking.tracker import Tracker, lone_tracker
from geogs.types import Frame
from geogs.world.grid import OFFSET, STRIDE
from geogs_synth.motion.handheld import HandheldPath
from geogs_synth.places.room import make_room
from geogs_synth.raycast.raycaster import Raycaster, RenderedView
from sequences import align

PRIORS = {"none": None, "good": PLAUSIBLE, "patchy": PATCHY, "bad": BAD}


@dataclass(frozen=True)
class Walk:
    """Views along a path."""

    camera: Camera
    views: list[RenderedView]
    T_wc: np.ndarray


@dataclass(frozen=True)
class Score:
    """Errors of poses and depths."""

    ate_cm: float
    """RMSE of the keyframes' positions."""
    median: float
    """Median relative depth error."""
    mean: float
    bare_median: float
    """The same where the image has no texture."""
    bare_mean: float
    textured_mean: float
    bare_share: float


def walk(seed: int, frames: int, long_edge: int, bare: bool = True) -> Walk:
    """A hand-held path through a room."""
    camera = Camera(272.0, 272.0, 159.5, 119.5, 320, 240).with_long_edge(long_edge)
    scene = with_bare_walls(make_room(seed)) if bare else make_room(seed)
    T_wc = HandheldPath(scene).at_frames(np.arange(frames))
    caster = Raycaster(scene)
    return Walk(camera, [caster.render(camera, T) for T in T_wc], T_wc)


def track(walk: Walk, prior: MonocularPrior | None, config: PriorConfig) -> Tracker:
    """Run a tracker on a whole walk."""
    tracker = lone_tracker(walk.camera, Config(prior=config or PriorConfig()), prior=prior)
    for n, view in enumerate(walk.views):
        tracker.track(Frame(n, n / 30, view.image))
    tracker.finish()
    return tracker


def score(tracker: Tracker, walk: Walk) -> Score:
    """Errors of a tracker's keyframes."""
    keyframes = [tracker.keyframes[k] for k in tracker.segment.ids]
    centres = np.stack([torch.linalg.inv(k.T_cw)[:3, 3].numpy() for k in keyframes])
    truth = walk.T_wc[[k.frame_index for k in keyframes], :3, 3]
    ate, scale = align(centres, truth)
    errors, bare = [], []
    for k in keyframes[1:-1]:
        depth = walk.views[k.frame_index].depth[OFFSET:-3:STRIDE, OFFSET:-3:STRIDE]
        errors.append(np.abs(scale / k.inverse_depth.numpy() / depth.ravel() - 1))
        grey = cv2.cvtColor(k.image, cv2.COLOR_RGB2GRAY)
        bare.append(cell_structure(grey).smaller < MIN_STRUCTURE)
    error, where = np.concatenate(errors), np.concatenate(bare)
    return Score(
        ate, float(np.median(error)), float(error.mean()), float(np.median(error[where])),
        float(error[where].mean()), float(error[~where].mean()), float(where.mean()),
    )  # fmt: skip


@dataclass(frozen=True)
class MapScore:
    """Errors of the map rendered from the keyframes."""

    mean: float
    """Mean relative depth error."""
    bare_mean: float
    bare_wrong: float
    """Fraction of the pixels without texture with errors above 5 %."""
    normal: float
    """Mean angle between normals, degrees."""
    bare_normal: float
    disks: int


def map_score(slam: Slam, walk: Walk) -> MapScore:
    """Errors of a finished map."""
    keyframes = slam.segments.main.keyframes
    states = [keyframes[k] for k in keyframes.ids]
    centres = np.stack([torch.linalg.inv(s.T_cw)[:3, 3].numpy() for s in states])
    _, scale = align(centres, walk.T_wc[[s.frame_index for s in states], :3, 3])
    errors, angles, bare = [], [], []
    for seen in slam.renders():
        view = walk.views[keyframes[seen.keyframe_id].frame_index]
        size = seen.depth.shape[::-1]
        nearest = cv2.INTER_NEAREST
        depth, normal = (
            cv2.resize(m, size, interpolation=nearest) for m in (view.depth, view.normal)
        )
        grey = cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY)
        xx, yy, xy = common_tensor(grey, grey)
        smaller = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
        plain = (smaller < MIN_STRUCTURE).astype(np.uint8)
        known = seen.depth.numpy() > 0
        errors.append(np.abs(scale * seen.depth.numpy() / depth - 1)[known])
        cosine = (normal * seen.normal.numpy()).sum(-1).clip(-1, 1)
        angles.append(np.degrees(np.arccos(cosine))[known])
        bare.append(cv2.resize(plain, size, interpolation=nearest)[known] > 0)
    error, angle, where = (np.concatenate(v) for v in (errors, angles, bare))
    return MapScore(
        float(error.mean()), float(error[where].mean()), float((error[where] > 0.05).mean()),
        float(angle.mean()), float(angle[where].mean()), len(slam.world.map.disks),
    )  # fmt: skip


def compare_maps(walk: Walk, kind: DepthKind, config: PriorConfig) -> None:
    """Print a table of maps, with and without the normals of the prior."""
    print_row("prior", "its normals", "depth", "bare", "bare > 5 %", "angle", "bare", "disks", "s")
    print("|---" * 9 + "|")
    cases = (
        ("none", None, False),
        ("good", PLAUSIBLE, False), ("good", PLAUSIBLE, True),
        ("patchy", PATCHY, True), ("bad", BAD, True),
    )  # fmt: skip
    for name, errors, with_normals in cases:
        mapping = MappingConfig()
        if not with_normals:
            loss = dataclasses.replace(mapping.loss, normal_weight=0.0)
            mapping = dataclasses.replace(mapping, loss=loss)
        prior = None if errors is None else DegradedPrior(walk.views, errors, kind)
        start = time.perf_counter()
        slam = Slam(walk.camera, Config(prior=config, mapping=mapping), prior=prior, device="cpu")
        for n, view in enumerate(walk.views):
            slam.process(Frame(n, n / 30, view.image))
        slam.finish()
        seconds, s = time.perf_counter() - start, map_score(slam, walk)
        print_row(
            name, "yes" if with_normals else "no", f"{s.mean:.2%}", f"{s.bare_mean:.2%}",
            f"{s.bare_wrong:.1%}", f"{s.normal:.1f}°", f"{s.bare_normal:.1f}°", s.disks,
            f"{seconds:.0f}",
        )  # fmt: skip


def print_row(*cells: object) -> None:
    """Print one line of a table."""
    print("| " + " | ".join(map(str, cells)) + " |", flush=True)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=80)
    parser.add_argument("--long-edge", type=int, default=320)
    parser.add_argument("--rooms", type=int, default=2)
    parser.add_argument("--textured", action="store_true", help="leave the walls as they are")
    parser.add_argument("--map", action="store_true", help="the whole system instead")
    parser.add_argument("--global", action="store_true", dest="all", help="adjust all at the end")
    parser.add_argument("--kind", choices=[k.value for k in DepthKind], default="scale_free")
    parser.add_argument("--set", nargs="*", default=[], help="name=value of PriorConfig")
    args = parser.parse_args()
    torch.set_num_threads(1)  # as in the system; our own threads use the cores
    changes = {k: json.loads(v) for k, v in (item.split("=") for item in args.set)}
    config = dataclasses.replace(PriorConfig(), **changes)
    for seed in range(args.rooms if args.map else 0):
        seen = walk(seed, args.frames, args.long_edge, not args.textured)
        compare_maps(seen, DepthKind(args.kind), config)
    if args.map:
        return
    print_row("room", "prior", "ATE cm", "depth", "mean", "bare depth", "mean", "textured", "s")
    print("|---" * 9 + "|")
    for seed in range(args.rooms):
        seen = walk(seed, args.frames, args.long_edge, not args.textured)
        for name, errors in PRIORS.items():
            kind = DepthKind(args.kind)
            prior = None if errors is None else DegradedPrior(seen.views, errors, kind)
            start = time.perf_counter()
            tracker = track(seen, prior, config)
            if args.all:
                global_bundle(tracker)
            seconds, s = time.perf_counter() - start, score(tracker, seen)
            print_row(
                f"{seed} ({s.bare_share:.0%} bare)", name, f"{s.ate_cm:.3f}", f"{s.median:.2%}",
                f"{s.mean:.2%}", f"{s.bare_median:.2%}", f"{s.bare_mean:.2%}",
                f"{s.textured_mean:.2%}", f"{seconds:.1f}",
            )  # fmt: skip


if __name__ == "__main__":
    main()
