"""Time and memory of the global adjustment of a long walk, with simulated matches.

    python benchmarks/global_ba.py [COUNT ...] [--rounds 1] [--iterations 2] [--drift 0.002]
    python benchmarks/global_ba.py --rooms [COUNT ...]

Each number of keyframes (200, 400, 800 and 1600 if none is given) runs in its own process:
the walk of tests/planted_walk.py on a grid of 64 x 36 cells, whose matches cost next to nothing, so
that the choice of pairs, the graph and the solver are measured. Printed are the pairs, the
seconds to choose them and in all, the peak memory above that of the loaded program and the error of
the poses in cm, before and after. With ``--rooms`` keyframes are spread over the long walk through
42 rooms (long_walk.py) and see a depth of 2.2 m everywhere; printed are the pairs, the band of the
camera system and the seconds of one solution.
"""

import argparse
import resource
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import numpy as np
import torch

from geogs.bundle.camera_system import SparseCameraSystem
from geogs.bundle.dense import FLOOR
from geogs.geometry.lie import se3_inverse
from geogs.loop import keyframe_matches as settings
from geogs.loop.global_bundle import global_bundle
from geogs.loop.keyframe_matches import global_pairs
from geogs.tracking.tracker import Tracker, lone_tracker
from geogs.world.segments import TrackState
from geogs_synth.sequence.location import centred_camera
from planted_walk import CAMERA, drift, planted_tracker
from sequences import align
from suite import Suite


def error_cm(tracker: Tracker, truth: torch.Tensor) -> float:
    """RMS distance of the camera centres after a similarity."""
    poses = (tracker.keyframes.poses(tracker.keyframes.ids), truth)
    return align(*(se3_inverse(T)[:, :3, 3].numpy() for T in poses))[0]


def peak() -> float:
    """Peak memory of the process, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(count: int, args: argparse.Namespace) -> None:
    """Adjust one walk in this process."""
    torch.set_num_threads(1)
    settings.ROUNDS, settings.PAIRS = args.rounds, args.pairs
    settings.GLOBAL_OPTIONS = replace(settings.GLOBAL_OPTIONS, iterations=args.iterations)
    tracker, truth = planted_tracker(count, CAMERA)
    drift(tracker, args.drift, args.yaw)
    base, before = peak(), error_cm(tracker, truth)
    tick = time.perf_counter()
    pairs = global_pairs(tracker)
    chosen, mid = time.perf_counter() - tick, peak()
    global_bundle(tracker)
    total = time.perf_counter() - tick - chosen
    print(
        f"{count:5d} keyframes, {len(pairs):6d} pairs: choice {chosen:6.1f} s (+{mid - base:.0f} "
        f"MiB), all {total:7.1f} s, peak +{peak() - base:.0f} MiB over {base:.0f}, "
        f"error {before:.2f} -> {error_cm(tracker, truth):.3f} cm",
        flush=True,
    )


def through_rooms(count: int) -> None:
    """Measure the pairs and the camera system of a walk through many rooms in this process."""
    torch.set_num_threads(1)
    walk = Suite.for_walk(12_000).walk(20_000, 0.6)
    tracker = lone_tracker(centred_camera(512, 288))
    tracker.segment.status.state = TrackState.TRACKING
    for n, at in enumerate(np.linspace(0, len(walk) - 1, count).astype(int)):
        T_cw = torch.from_numpy(np.linalg.inv(walk[at]))
        state = tracker.keyframes.add(n, n / 3, np.zeros((4, 4, 3), np.uint8), None, T_cw)
        state.inverse_depth = torch.full((tracker.keyframes.grid.size,), 1 / 2.2)
    tick = time.perf_counter()
    pairs = global_pairs(tracker)
    chosen = time.perf_counter() - tick
    edges = torch.tensor(sorted(pairs + [(j, i) for i, j in pairs]))
    system = SparseCameraSystem(edges[:, 0], edges[:, 1], torch.arange(count) > 0)
    system.add_sums(  # positive definite, which is enough to measure the time
        torch.eye(6, dtype=torch.float64).expand(system.size, 6, 6) / system.size,
        torch.ones(count, 6, dtype=torch.float64),
    )
    tick = time.perf_counter()
    system.solve(1.0, FLOOR)
    print(
        f"{count:5d} keyframes, {len(pairs):6d} pairs: choice {chosen:6.1f} s, {system.size} "
        f"blocks, at most {system.bandwidth} frames apart, "
        f"solved in {time.perf_counter() - tick:.2f} s",
        flush=True,
    )


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("counts", nargs="*", type=int, default=[200, 400, 800, 1600])
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--iterations", type=int, default=2)
    parser.add_argument("--pairs", type=int, default=13, help="most pairs per keyframe")
    parser.add_argument("--drift", type=float, default=0.002, help="growth of lengths to the end")
    parser.add_argument("--yaw", type=float, default=0.0, help="turn to the end, radians")
    parser.add_argument("--rooms", action="store_true", help="of the long walk: the system alone")
    args = parser.parse_args()
    if args.rooms:
        for count in args.counts:
            through_rooms(count)
        return
    if len(args.counts) == 1:
        measure(args.counts[0], args)
        return
    options = [f"--{k}={v}" for k, v in vars(args).items() if k not in ("counts", "rooms")]
    for count in args.counts:
        subprocess.run([sys.executable, __file__, str(count), *options], check=True)


if __name__ == "__main__":
    main()
