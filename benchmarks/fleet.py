"""Cost and gain of fleets: `geogs fleet` measured on one machine.

    python benchmarks/fleet.py overhead [--rooms 16] [--cores 2]
    python benchmarks/fleet.py tiny [--sources 1000]
    python benchmarks/fleet.py kills [--sources 50] [--nodes 4]
    python benchmarks/fleet.py gpus [--rooms 12] [--share 0.25]
    python benchmarks/fleet.py join [--walk 5000] [--every 2] [--parts 10]

Respectively: rooms as a fleet against a loop of the shell; the time of scheduling alone; nodes lost
at random; rooms a minute on one GPU and on all; a walk in overlapping parts against one run.
Each prints lines of JSON. Rooms are short sequences of `geogs synth`, the walk is that of
`long_walk.py`; both are rendered first, into ``--folder``. Sources of `tiny` and `kills` are
computed by a stand-in that ends at once, or takes three seconds in steps that it saves.
"""

import argparse
import json
import os
import random
import resource
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor, wait
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

import geogs
from geogs.evaluation.trajectory_errors import TrajectoryErrors, evaluate_trajectory
from geogs.geometry.camera import Camera
from geogs.types import Trajectory
from geogs_fleet.cluster import ray_cluster
from geogs_fleet.fleet_options import FleetOptions
from geogs_fleet.fleet_run import run_fleet
from geogs_synth.sequence.location import centred_camera
from long_walk import render
from portals import SuiteRaycaster
from suite import Suite

GEOGS = (sys.executable, "-m", "geogs.cli.main")
TESTS = Path(__file__).resolve().parents[1] / "tests"
STAND_IN = (sys.executable, str(TESTS / "fleet" / "fake_child.py"))
STEPS = 15
"""Number of steps of a source of `kills`, of 0.2 s each."""
FRAMES_A_SECOND = 30.0
_NEAREST = 0.2
"""Largest distance of a scored vertex to a point that was seen, metres."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("what", choices=("overhead", "tiny", "kills", "gpus", "join"))
    parser.add_argument("--folder", type=Path, default=Path("out/fleet_benchmark"))
    parser.add_argument("--rooms", type=int, default=12)
    parser.add_argument("--frames", type=int, default=40, help="of a room")
    parser.add_argument("--size", type=int, nargs=2, default=(320, 240), help="of a room's images")
    parser.add_argument("--preset", default="fast", choices=("fast", "default", "accurate"))
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--sources", type=int, default=1000)
    parser.add_argument("--nodes", type=int, default=4)
    parser.add_argument("--share", type=float, default=0.25, help="of a GPU, of a room or a part")
    parser.add_argument("--walk", type=int, default=5000, help="frames of the whole walk")
    parser.add_argument("--every", type=int, default=2, help="of them one in so many is taken")
    parser.add_argument("--parts", type=int, default=10)
    parser.add_argument("--device", default="cuda", choices=("cpu", "cuda"), help="of the walk")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    run = {"overhead": overhead, "tiny": tiny, "kills": kills, "gpus": gpus, "join": join}
    run[options.what](options)


def overhead(options: argparse.Namespace) -> None:
    """Time rooms as a fleet, and as a loop that starts the next when one ends; one on each core."""
    rooms = rendered_rooms(options)
    out = options.folder / "overhead"
    alone = ["--device", "cpu", "--preset", options.preset]
    loop = (
        f"printf '%s\\n' {' '.join(map(str, rooms))} | xargs -P {options.cores} -I @ "
        f"sh -c '{' '.join(GEOGS)} run @ -q {' '.join(alone)} -o {out}/loop/$(basename @)'"
    )
    one = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    seconds = {"loop": took(["sh", "-c", loop], one)}
    fleet = [
        *GEOGS, "fleet", "run", *map(str, rooms), "-q", "-o", str(out / "fleet"), "--cpus", "1",
        "--gpus", "0", "--address", "local", "--preset", options.preset,
    ]  # fmt: skip
    seconds["fleet"] = took(fleet)
    ratio = seconds["fleet"] / seconds["loop"]
    report("overhead", rooms=len(rooms), **seconds, overhead_percent=round(100 * (ratio - 1), 1))


def tiny(options: argparse.Namespace) -> None:
    """Measure seconds between sources that end at once, and the driver's processor time and
    memory."""
    given = texts(options.folder / "tiny", options.sources, "ok")
    settings = FleetOptions((str(given),), output=str(options.folder / "tiny-out"), gpus=0.0)
    with ray_cluster("local"):
        memory = most_memory()
        began, spent = time.perf_counter(), time.process_time()
        rows = run_fleet(settings, None, STAND_IN).rows
        seconds, processor = time.perf_counter() - began, time.process_time() - spent
    report(
        "tiny", sources=len(rows), done=sum(row.state == "done" for row in rows),
        cores=len(os.sched_getaffinity(0)), ms_each=round(1e3 * seconds / len(rows), 1),
        driver_ms_each=round(1e3 * processor / len(rows), 1),
        driver_MiB=[round(memory), round(most_memory())],
    )  # fmt: skip


def kills(options: argparse.Namespace) -> None:
    """Kill nodes at random times while sources are computed, and add as many again."""
    sys.path.insert(0, str(TESTS / "fleet"))
    sys.path.insert(0, str(TESTS))
    from cluster_nodes import add_node, simulated_cluster

    given = texts(options.folder / "kills", options.sources, f"steps {STEPS}")
    out, lost = options.folder / "kills-out", 0
    settings = FleetOptions((str(given),), output=str(out), gpus=0.0, attempts=20)
    with simulated_cluster(cpus=1) as cluster, ThreadPoolExecutor(1) as pool:
        nodes, rng = [add_node(cluster) for _ in range(options.nodes)], random.Random(0)
        fleet = pool.submit(run_fleet, settings, None, STAND_IN)
        while not wait([fleet], rng.uniform(2, 5)).done:
            gone = nodes.pop(rng.randrange(len(nodes)))
            cluster.remove_node(gone, allow_graceful=False)
            lost += 1
            nodes.append(add_node(cluster))  # Ray requires the main thread for this
        rows = fleet.result().rows
    steps = [(out / row.name / "steps").read_text().split() for row in rows]
    report(
        "kills", sources=len(rows), nodes_lost=lost, done=sum(r.state == "done" for r in rows),
        most_attempts=max(row.attempts for row in rows),
        steps_lost_or_twice=sum(s != list(map(str, range(STEPS))) for s in steps),
    )  # fmt: skip


def gpus(options: argparse.Namespace) -> None:
    """Measure rooms a minute, one at a time and several, on one GPU and on all."""
    rooms = rendered_rooms(options)
    count = torch.cuda.device_count()
    ways = [(1, 1.0), (1, options.share)] + [(count, 1.0), (count, options.share)] * (count > 1)
    warm = [*GEOGS, "run", str(rooms[0]), "-q", "-o", str(options.folder / "warm")]
    warm += ["--overwrite", "--no-strict"]
    subprocess.run([*warm, "--device", "cuda", "--preset", options.preset], check=True)
    minutes = {}
    for seen, share in ways:
        name = f"{seen} x {1 / share:g}"
        command = [
            *GEOGS, "fleet", "run", *map(str, rooms), "-q", "--address", "local", "--gpus",
            str(share), "-o", str(options.folder / f"gpus-{seen}-{share}"), "--preset",
            options.preset,
        ]  # fmt: skip
        visible = ",".join(map(str, range(seen)))
        minutes[name] = took(command, {**os.environ, "CUDA_VISIBLE_DEVICES": visible}) / 60
        report("gpus", gpus_x_at_once=name, rooms_a_minute=round(len(rooms) / minutes[name], 2),
               times_the_first=round(minutes["1 x 1"] / minutes[name], 2))  # fmt: skip


def join(options: argparse.Namespace) -> None:
    """Compare a walk through many rooms as one run, and as overlapping parts that are joined."""
    suite, camera = Suite.for_walk(options.walk), centred_camera(512, 288)
    images = options.folder / f"{suite.rooms}-rooms"
    frames = range(0, options.walk, options.every)
    render(suite, camera, images, frames)
    ends = np.linspace(0, len(frames), options.parts + 1).astype(int)
    overlap = len(frames) // options.parts // 10
    spans = [frames[max(a - overlap, 0) : b] for a, b in pairwise(ends)]
    parts = [linked(options.folder / f"part{n:02d}", images, s) for n, s in enumerate(spans)]
    whole = linked(options.folder / "whole", images, frames)
    truth, points, normals = suite.walk(options.walk), *seen_surface(suite, camera, options)
    intrinsics = f"--intrinsics={camera.fx},{camera.fy},{camera.cx},{camera.cy}"
    told = [intrinsics, "--preset", options.preset, "-q"]
    share = str(options.share if options.device == "cuda" else 0)
    out = {"one run": options.folder / "out-whole", "joined": options.folder / "out-joined"}
    given = {"one run": [frames], "joined": spans}
    commands = {
        "joined": [
            *GEOGS, "fleet", "join", *map(str, parts), "--address", "local", "--gpus", share,
            "-o", str(out["joined"]), *told,
        ],
        "one run": [*GEOGS, "run", str(whole), "--device", options.device, "-o",
                    str(out["one run"]), "--overwrite", "--no-strict", *told],
    }  # fmt: skip
    for name, command in commands.items():
        seconds = took(command)
        errors = path_errors(out[name], given[name], truth)
        mesh = geogs.load_result(out[name]).mesh
        vertices = np.zeros((0, 3)) if mesh is None else mesh.vertices
        report(
            "join", way=name, seconds=round(seconds), ate_cm=round(errors.ate_rmse_cm, 2),
            acc_cm=round(accuracy(vertices, errors.T_ref_est, points, normals), 2),
            frames=errors.estimated, vertices=len(vertices),
        )  # fmt: skip


def rendered_rooms(options: argparse.Namespace) -> list[Path]:
    """Render rooms of different seeds, as many at a time as there are cores."""
    folder, (width, height) = options.folder / "rooms", map(str, options.size)
    folder.mkdir(exist_ok=True)
    rooms = [folder / f"room{seed:02d}" for seed in range(options.rooms)]
    waiting: list[subprocess.Popen[bytes]] = []
    for seed, room in enumerate(rooms):
        if room.is_dir():
            continue
        if len(waiting) == len(os.sched_getaffinity(0)):
            waiting.pop(0).wait()
        command = [*GEOGS, "synth", str(room), "--seed", str(seed), "--width", width, "--height",
                   height, "--frames", str(options.frames), "--no-depth"]  # fmt: skip
        waiting.append(subprocess.Popen(command, stdout=subprocess.DEVNULL))
    for process in waiting:
        process.wait()
    return rooms


def texts(folder: Path, number: int, text: str) -> Path:
    """Write sources of the stand-in, all with the same text."""
    folder.mkdir(exist_ok=True)
    for n in range(number):
        (folder / f"s{n:04d}.mp4").write_text(text)
    return folder


def linked(folder: Path, images: Path, frames: range) -> Path:
    """Make a folder of links to some of the images."""
    folder.mkdir(exist_ok=True)
    for n in frames:
        link = folder / f"frame{n:06d}.jpg"
        if not link.exists():
            link.symlink_to((images / link.name).resolve())
    return folder


def seen_surface(
    suite: Suite, camera: Camera, options: argparse.Namespace
) -> tuple[np.ndarray, np.ndarray]:
    """True points and normals that one in ten of the walk's frames see."""
    small = camera.resized(camera.width // 2, camera.height // 2)
    caster = SuiteRaycaster(suite, len(os.sched_getaffinity(0)))
    points, normals = [], []
    for T_wc in suite.walk(options.walk)[:: 10 * options.every]:
        depth = caster.render(small, T_wc)[1].astype(np.float64)
        world = small.back_project(torch.from_numpy(depth)).numpy() @ T_wc[:3, :3].T + T_wc[:3, 3]
        across, down = world[1:-1, 2:] - world[1:-1, :-2], world[2:, 1:-1] - world[:-2, 1:-1]
        normal = np.cross(across, down)
        length = np.linalg.norm(normal, axis=2)
        inner = depth[1:-1, 1:-1]
        smooth = np.abs(depth[1:-1, 2:] + depth[1:-1, :-2] - 2 * inner) < 0.01 * inner
        kept = (inner > 0) & smooth & (length > 0)
        points.append(world[1:-1, 1:-1][kept])
        normals.append((normal / np.maximum(length, 1e-12)[..., None])[kept])
    return np.concatenate(points), np.concatenate(normals)


def accuracy(vertices: np.ndarray, T: np.ndarray, points: np.ndarray, normals: np.ndarray) -> float:
    """Median distance of a mesh from the planes of the nearest seen points, centimetres."""
    world = vertices.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    distance, nearest = cKDTree(points).query(world, distance_upper_bound=_NEAREST, workers=-1)
    near = np.isfinite(distance)
    offset = world[near] - points[nearest[near]]
    return float(100 * np.median(np.abs((offset * normals[nearest[near]]).sum(1))))


def path_errors(output: Path, given: list[range], truth: np.ndarray) -> TrajectoryErrors:
    """Errors of a result whose frames are those of the parts, one part after the other."""
    result = geogs.load_result(output)
    videos = json.loads((output / "summary.json").read_text()).get("videos")
    starts = [v["first_time"] for v in videos] if videos else [0.0]
    names = [v["name"] for v in videos] if videos else ["whole"]
    times, poses = [], []
    for name, start in zip(names, starts, strict=True):
        part = given[int(name.removeprefix("part"))] if videos else given[0]
        times.append(start + np.arange(len(part)) / FRAMES_A_SECOND)
        poses.append(truth[list(part)])
    stamps = np.concatenate(times)
    reference = Trajectory(stamps, np.concatenate(poses), np.ones(len(stamps), dtype=bool))
    return evaluate_trajectory(result.trajectory, reference)


def took(command: list[str], environment: dict[str, str] | None = None) -> float:
    """Seconds of a command; its exit code is printed, and a failure is not raised."""
    began = time.perf_counter()
    code = subprocess.run(command, env=environment).returncode
    seconds = round(time.perf_counter() - began, 2)
    print(f"{seconds} s, exit {code}: {' '.join(command)[:100]} …", file=sys.stderr)
    return seconds


def most_memory() -> float:
    """Peak memory of this process so far, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def report(what: str, **figures: object) -> None:
    print(json.dumps({"what": what, **figures}), flush=True)


if __name__ == "__main__":
    main()
