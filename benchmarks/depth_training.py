"""Where the time of the depth network's training goes, on a GPU.

    python benchmarks/depth_training.py [--fuse] [--profile]

How fast rooms are drawn and rendered, how long steps with small and large images take for few and
many neighbours, and how much memory they need.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace

import torch

from geogs_train.course import Worker
from geogs_train.depth.depth_course import DepthCourse
from geogs_train.depth.depth_options import DepthTraining, PoolOptions
from geogs_train.network_trainer import NetworkTrainer


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plans", type=int, default=4)
    parser.add_argument("--steps", type=int, default=8)
    parser.add_argument("--batch", type=int, default=12)
    parser.add_argument("--small-batch", type=int, default=24)
    parser.add_argument("--neighbours", type=int, nargs="*", default=(3, 5, 8))
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--fuse", action="store_true")
    parser.add_argument("--profile", action="store_true")
    options = parser.parse_args()
    device = torch.device(options.device)
    for neighbours in options.neighbours:
        training = DepthTraining(
            batch=options.batch,
            small_batch=options.small_batch,
            pool=PoolOptions(plans=options.plans, refresh=1000),
        )
        training = replace(
            training,
            rooms=replace(training.rooms, textures=32, texture_size=256),
            tuples=replace(
                training.tuples, least_neighbours=neighbours, most_neighbours=neighbours
            ),
        )
        course = DepthCourse(training, Worker(device))
        trainer = NetworkTrainer(course, Worker(device), options.fuse)
        if neighbours == options.neighbours[0]:
            measure_rooms(course, training, device)
        for small in (True, False):
            measure_steps(trainer, course, small, neighbours, options)
        course.close()


def measure_rooms(course: DepthCourse, training: DepthTraining, device: torch.device) -> None:
    """Drawing and rendering of one batch of rooms."""
    for pool, name in zip(course._pools, ("large", "small"), strict=True):
        begin = time.perf_counter()
        plan = pool._rooms.plan(10**6, training.pool.rooms, 0)
        drawn = time.perf_counter() - begin
        seconds = timed(lambda plan=plan, pool=pool: pool._rooms.film(plan), 3, device)
        views = training.pool.rooms * training.rooms.views
        print(f"{name}: plan {drawn:.3f} s, film {seconds:.3f} s, {views / seconds:.0f} views/s")


def measure_steps(
    trainer: NetworkTrainer,
    course: DepthCourse,
    small: bool,
    neighbours: int,
    options: argparse.Namespace,
) -> None:
    """Steps with one size of images and one number of neighbours."""
    device = trainer.worker.device
    progress = 0.1 if small else 0.9
    begin = time.perf_counter()
    course.batch(0, progress)
    synchronise(device)
    filled = time.perf_counter() - begin
    drawing = timed(lambda: course.batch(0, progress), options.steps, device)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats()

    def one() -> None:
        trainer.step, trainer.progress = 0, progress
        trainer.advance()

    begin = time.perf_counter()
    one()
    synchronise(device)
    first = time.perf_counter() - begin
    seconds = timed(one, options.steps, device)
    count = options.small_batch if small else options.batch
    peak = torch.cuda.max_memory_allocated() / 2**30 if device.type == "cuda" else 0.0
    print(
        f"{'small' if small else 'large'}, {neighbours} neighbours: pool {filled:.1f} s, draw "
        f"{1e3 * drawing:.0f} ms, first step {first:.1f} s, step {1e3 * seconds:.0f} ms, "
        f"{count / seconds:.0f} samples/s, {peak:.1f} GiB",
        flush=True,
    )
    if options.profile and neighbours == 5:
        activities = [torch.profiler.ProfilerActivity.CUDA, torch.profiler.ProfilerActivity.CPU]
        with torch.profiler.profile(activities=activities) as profile:
            one()
            synchronise(device)
        table = profile.key_averages().table(sort_by="cuda_time_total", row_limit=25)
        print("\n".join(line[:60] + line[-130:] for line in table.splitlines()))


def timed(work: Callable[[], object], repeats: int, device: torch.device) -> float:
    """Seconds of one call after a first one."""
    work()
    synchronise(device)
    begin = time.perf_counter()
    for _ in range(repeats):
        work()
    synchronise(device)
    return (time.perf_counter() - begin) / repeats


def synchronise(device: torch.device) -> None:
    """Wait for a GPU."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


if __name__ == "__main__":
    main()
