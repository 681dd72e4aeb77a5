"""Threads for kernels that release the interpreter lock."""

import functools
import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


def run_chunks(function: Callable[[int], object], chunks: int, threads: int) -> None:
    """Call ``function(chunk)`` for every chunk; threads take the next one as they become free.

    The caller's thread takes part. The first exception is raised once all threads are done.
    """
    counter = itertools.count()

    def work() -> None:
        while (chunk := next(counter)) < chunks:
            function(chunk)

    helpers = min(threads, chunks) - 1
    if helpers < 1:
        work()
        return
    executor = _executor(threads, os.getpid())
    futures = [executor.submit(work) for _ in range(helpers)]
    try:
        work()
    finally:
        for future in futures:
            future.result()


@functools.cache
def _executor(threads: int, process: int) -> ThreadPoolExecutor:
    """One pool per process: threads do not survive a fork."""
    return ThreadPoolExecutor(threads - 1, thread_name_prefix="splat")
