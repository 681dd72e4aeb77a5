"""Time and memory along a long video: a walk through many furnished rooms.

    python benchmarks/long_walk.py [--frames 5000] [--images 5000] [--size 512 288] [--device cuda]
        [--preset fast] [--folder FOLDER] [--online] [--seconds 540] [--output FILE] [--renderers 1]
        [--pace 1]

The walk is rendered once for all runs into ``--folder``, in another process before the whole system
runs on it, or by several ``--renderers`` that stay ahead of it; reading images, and waiting for
them, does not count. Printed are, for every 500 frames, the milliseconds per keyframe of each
stage, the memory of the process (and of the GPU), keyframes and disks; then the start of each later
part, up to the mesh, in seconds after the last frame; then, stage by stage and for memory, the last
500 frames against the first, and the trajectory errors. ``--walk`` keeps the rooms of a longer walk
of which only the beginning is used. At half the ``--pace`` the camera moves half as far with each
frame, through half as many rooms. With fewer ``--images`` than frames the walk goes back and forth.
``--seconds`` ends it early, with the results up to then.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from geogs.application.results.surfaces import fusion_views
from geogs.config import preset
from geogs.evaluation.trajectory_errors import evaluate_trajectory
from geogs.geometry.camera import Camera
from geogs.mesh.extract import extract_mesh
from geogs.slam import Slam
from geogs.types import Frame, Trajectory
from geogs_synth.sequence.location import centred_camera
from portals import SuiteRaycaster
from suite import Suite

_PATIENCE = 600
"""Longest wait for the next image, seconds."""
_TOGETHER = 100
"""Consecutive frames of one of several renderers: each keeps few rooms in memory, and the next
frames are finished first."""


@dataclass(frozen=True)
class Block:
    """Cost of a block of frames."""

    frames: int
    """Number of frames at its end."""
    keyframes: int
    disks: int
    stages: dict[str, float]
    """Milliseconds per new keyframe."""
    total: float
    """Sum over the stages."""
    per_frame: float
    """Milliseconds per frame: there are more keyframes where more of the scene is new."""
    processor: float
    """Milliseconds of all CPU threads per new keyframe, independent of the machine's load."""
    resident: float
    """Memory of the process at the end, gigabytes."""
    peak: float
    """Peak memory so far, gigabytes."""
    gpu: float
    """Peak memory of the GPU within the block, gigabytes."""
    lost: int


def main() -> None:
    options = parse()
    suite = Suite.for_walk(round(options.pace * (options.walk or options.frames)))
    camera = centred_camera(*options.size)
    name = f"{suite.rooms}-rooms-{camera.width}x{camera.height}"
    folder = options.folder / (name if options.pace == 1 else f"{name}-{options.pace:g}")
    rendered = min(options.images or options.frames, options.frames)
    if options.render_only:
        part, parts = options.part, options.renderers
        mine = [n for n in range(rendered) if n // _TOGETHER % parts == part]
        render(suite, camera, folder, mine, parts, options.pace)
        return
    renderers = [
        subprocess.Popen(
            [sys.executable, __file__, *sys.argv[1:], "--render-only", "--part", str(n)]
        )
        for n in range(options.renderers)
    ]
    if len(renderers) == 1 and renderers[0].wait():
        sys.exit("The walk could not be rendered.")
    slam = Slam(camera, preset(options.preset), options.device)
    images = [to_and_fro(n, rendered) for n in range(options.frames)]
    blocks = follow(slam, folder, images, options.every, options.seconds)
    truth = suite.walk(rendered, options.pace)[images[: slam.frames]]
    errors = {}
    start = time.perf_counter()
    slam.end_stream()
    errors["online"] = ate(slam, truth)
    ending: dict[str, float] = {}
    if not options.online:
        slam.finish(Clock(start))
        errors["final"] = ate(slam, truth)
        ending["finished"] = round(time.perf_counter() - start, 1)
        mesh = extract_mesh(fusion_views(slam.renders()), slam.config.mesh)
        ending |= {"triangles": len(mesh.faces), "mesh": round(time.perf_counter() - start, 1)}
    used = [b for b in blocks if b.total > 0]
    result = {
        "options": {k: str(v) for k, v in vars(options).items()},
        "blocks": [asdict(b) for b in blocks],
        "frames": slam.frames,
        "ratio": round(used[-1].total / used[0].total, 3),
        "stage_ratios": last_against_first(used[0].stages, used[-1].stages),
        "memory_ratios": {
            k: round(getattr(used[-1], k) / max(getattr(used[0], k), 1e-3), 2)
            for k in ("resident", "gpu")
        },
        "per_frame_ratio": round(used[-1].per_frame / used[0].per_frame, 3),
        "processor_ratio": round(used[-1].processor / used[0].processor, 3),
        "peak": memory("VmHWM"),
        "gpu_peak": torch.cuda.max_memory_allocated() / 1e9 if options.device == "cuda" else 0.0,
        "ending": ending,
        "ate_cm": errors,
        "seconds": {k: round(v, 2) for k, v in slam.stopwatch.seconds.items()},
    }
    print(json.dumps({k: v for k, v in result.items() if k != "blocks"}, indent=1))
    if options.output is not None:
        options.output.write_text(json.dumps(result, indent=1) + "\n")


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--frames", type=int, default=5000)
    parser.add_argument(
        "--images", type=int, help="frames rendered; to and fro where there are more"
    )
    parser.add_argument("--seconds", type=float, help="ends the walk early")
    parser.add_argument("--walk", type=int, help="frames of the whole walk, if only begun")
    parser.add_argument("--size", type=int, nargs=2, default=(512, 288))
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--preset", default="fast", choices=("fast", "default", "accurate"))
    parser.add_argument("--every", type=int, default=500, help="frames of a block")
    parser.add_argument("--online", action="store_true", help="leave out what follows the video")
    parser.add_argument("--folder", type=Path, default=Path("out/long_walk"))
    parser.add_argument("--output", type=Path, help="JSON file")
    parser.add_argument("--renderers", type=int, default=1, help="processes")
    parser.add_argument("--pace", type=float, default=1.0, help="of the camera")
    parser.add_argument("--render-only", action="store_true")
    parser.add_argument("--part", type=int, default=0, help="which of those processes it is")
    return parser.parse_args()


def render(
    suite: Suite, camera: Camera, folder: Path, frames: Sequence[int],
    sharing: int = 1, pace: float = 1.0,
) -> None:  # fmt: skip
    """Write the missing ones of these frames, in one of ``sharing`` processes that share the
    cores."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"frame{n:06d}.jpg" for n in frames]
    if all(path.exists() for path in paths):
        return
    threads = max(len(os.sched_getaffinity(0)) // sharing, 1)
    caster, poses = SuiteRaycaster(suite, threads), suite.walk(max(frames) + 1, pace)[list(frames)]
    with ThreadPoolExecutor(threads) as pool:
        for path, T_wc in zip(paths, poses, strict=True):
            if not path.exists():
                pool.submit(write, path, caster.render(camera, T_wc)[0])


def write(path: Path, image: np.ndarray) -> None:
    part = path.with_suffix(".part")
    part.write_bytes(cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1])
    part.rename(path)


def read(path: Path) -> np.ndarray:
    """Read an image as soon as it is rendered."""
    begin = time.perf_counter()
    while not path.exists():
        if time.perf_counter() - begin > _PATIENCE:
            sys.exit(f"{path} is not being rendered.")
        time.sleep(0.01)
    return cv2.imread(str(path))


def to_and_fro(n: int, images: int) -> int:
    """Index of the image of frame n in a walk that turns back at either end of the images."""
    period = max(2 * (images - 1), 1)
    return min(n % period, period - n % period)


def last_against_first(
    first: dict[str, float], last: dict[str, float]
) -> dict[str, list[float | None]]:
    """Milliseconds per keyframe of each stage in the first and the last block, and their ratio.

    The ratio is none for a stage that was not there at first.
    """
    both = {k: (first.get(k, 0.0), v) for k, v in last.items()}
    return {k: [a, b, round(b / a, 2) if a else None] for k, (a, b) in both.items()}


def follow(
    slam: Slam, folder: Path, images: list[int], every: int, seconds: float | None
) -> list[Block]:
    """Feed the frames and measure every block of them, and the last one when the time is over."""
    blocks: list[Block] = []
    before, known, lost, status, spent = {}, 0, 0, None, 0.0
    end, frames = time.perf_counter() + (seconds or float("inf")), len(images)
    for n, image in enumerate(images):
        pixels = read(folder / f"frame{image:06d}.jpg")
        start = time.process_time()
        status = slam.process(Frame(n, n / 30, np.ascontiguousarray(pixels[..., ::-1])))
        spent += time.process_time() - start
        lost += status.state.value == "lost"
        is_late = time.perf_counter() > end
        if (n + 1) % every and n + 1 < frames:
            if is_late:
                break  # an incomplete block is less reliable than the last complete one
            continue
        now = dict(slam.stopwatch.seconds)
        fresh = max(status.keyframes - known, 1)
        stages = {k: 1e3 * (now[k] - before.get(k, 0.0)) / fresh for k in now}
        gpu, total = 0.0, sum(stages.values())
        if slam.world.map.disks.device.type == "cuda":
            gpu = torch.cuda.max_memory_allocated() / 1e9
            torch.cuda.reset_peak_memory_stats()
        blocks.append(Block(
            n + 1, status.keyframes, status.disks, {k: round(v, 1) for k, v in stages.items()},
            round(total, 1), round(total * fresh / (n % every + 1), 1),
            round(1e3 * spent / fresh, 1),
            memory("VmRSS"), memory("VmHWM"), round(gpu, 3), lost,
        ))  # fmt: skip
        print(json.dumps(asdict(blocks[-1])), flush=True)
        before, known, spent = now, status.keyframes, 0.0
        if is_late:
            break
    return blocks


def memory(field: str) -> float:
    """Memory of this process in gigabytes: VmRSS now, VmHWM at its peak."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field):
            return round(int(line.split()[1]) * 1024 / 1e9, 3)
    return 0.0


class Clock:
    """Progress of the stages after the video: prints when each begins."""

    def __init__(self, start: float) -> None:
        self.start, self.known = start, ""

    def __call__(self, stage: str, fraction: float) -> None:
        if stage != self.known:
            seconds, self.known = time.perf_counter() - self.start, stage
            print(f"{seconds:.1f} s, {memory('VmRSS')} GB: {stage}", flush=True)


def ate(slam: Slam, truth: np.ndarray) -> float:
    """Root mean square position error after a similarity, centimetres."""
    n = len(truth)
    reference = Trajectory(np.arange(n) / 30, truth, np.ones(n, dtype=bool))
    return round(evaluate_trajectory(slam.trajectory(), reference).ate_rmse_cm, 2)


if __name__ == "__main__":
    main()
