"""Milliseconds of work on a GPU: between CUDA events, and kernel by kernel from the profiler."""

import statistics
from collections.abc import Callable

import torch
from torch.profiler import ProfilerActivity, profile


def median_milliseconds(step: Callable[[], object], repeat: int) -> float:
    """Median time of a step on the device, after a warm-up."""
    for _ in range(3):
        step()
    times = []
    for _ in range(repeat):
        before, after = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        before.record()
        step()
        after.record()
        after.synchronize()
        times.append(before.elapsed_time(after))
    return statistics.median(times)


def kernel_milliseconds(step: Callable[[], object], repeat: int) -> dict[str, float]:
    """Mean time of each kernel and copy in a step, the longest first."""
    with profile(activities=[ProfilerActivity.CUDA]) as profiler:
        for _ in range(repeat):
            step()
        torch.cuda.synchronize()
    times = {e.key: e.self_device_time_total / 1e3 / repeat for e in profiler.key_averages()}
    return dict(sorted(((k, t) for k, t in times.items() if t > 0), key=lambda item: -item[1]))
