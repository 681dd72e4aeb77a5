"""Threads of the compiled kernels, apart from PyTorch's own.

PyTorch's OpenMP threads spin for a while after each operation. On a machine with few cores they
take the cores that our kernels' threads need next, and a training step becomes several times
slower (measured on two cores: tracking eleven times, mapping six). So kernels use the threads of
this module, and PyTorch is limited to one while they work.
"""

import functools
import itertools
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from typing import ParamSpec, Protocol, TypeVar, runtime_checkable

import numpy as np
import torch

T = TypeVar("T")
R = TypeVar("R")
P = ParamSpec("P")


def available_cores() -> int:
    """Return the number of CPUs that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS
        return os.cpu_count() or 1


@functools.cache
def worker_count() -> int:
    """Return the number of CPUs to use: at most OMP_NUM_THREADS, if set, and at most 16."""
    wanted = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, min(available_cores(), int(wanted) if wanted.isdigit() else 16, 16))


def thread_map(
    function: Callable[[T], R],
    items: Sequence[T],
    progress: Callable[[float], None] = lambda fraction: None,
) -> list[R]:
    """Run ``list(map(function, items))`` over the workers; results in the order of the items.

    The caller's thread takes part, and reports the ``progress``. After an exception, of an item or
    of ``progress``, items that have not begun are skipped.
    """
    results: dict[int, R] = {}
    caller = threading.get_ident()
    reported = 0

    def report() -> None:
        nonlocal reported
        while reported < len(results):
            reported += 1
            progress(reported / len(items))

    def one(n: int) -> None:
        results[n] = function(items[n])
        if threading.get_ident() == caller:
            report()

    run_chunks(one, len(items), worker_count())
    report()
    return [results[n] for n in range(len(items))]


@runtime_checkable
class Each(Protocol):
    """``map``, or a function like it that computes the next results ahead."""

    def __call__(self, function: Callable[[T], R], items: Iterable[T], /) -> Iterator[R]:
        """Return the results in the order of the items."""
        ...


def ordered_map(
    function: Callable[[T], R], items: Iterable[T], threads: int, name: str = ""
) -> Iterator[R]:
    """Run ``map(function, items)``; a few threads compute the next results ahead.

    Besides the requested item, at most one item per thread is taken.
    """
    pool = ThreadPoolExecutor(threads, thread_name_prefix=name)
    pending: deque[Future[R]] = deque()
    try:
        for item in items:
            pending.append(pool.submit(function, item))
            if len(pending) > threads:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


def run_chunks(function: Callable[[int], object], chunks: int, threads: int) -> None:
    """Call ``function(chunk)`` for every chunk; threads take the next one as they become free.

    The caller's thread takes part. After an exception, chunks that have not begun are skipped; it
    is raised once all threads are done. Nested calls share the threads.
    """
    counter = itertools.count()
    failed = False

    def work() -> None:
        nonlocal failed
        try:
            while not failed and (chunk := next(counter)) < chunks:
                function(chunk)
        except BaseException:
            failed = True
            raise

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
            # One that has not begun waits behind other work, and nothing is left for it to do.
            if not future.cancel():
                future.result()


def over_rows(kernel: Callable[[int, int], object], height: int) -> None:
    """Call ``kernel(first, last)`` on equal spans of rows, one per worker."""
    count = max(1, min(worker_count(), height // 16))
    bounds = [height * k // count for k in range(count + 1)]
    run_chunks(lambda k: kernel(bounds[k], bounds[k + 1]), count, count)


@functools.cache
def _executor(threads: int, process: int) -> ThreadPoolExecutor:
    """Return one pool per process: threads do not survive a fork. Each has one PyTorch thread."""
    return ThreadPoolExecutor(
        threads - 1, thread_name_prefix="geogs", initializer=torch.set_num_threads, initargs=(1,)
    )


def on_one_torch_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Limit PyTorch to one thread while the decorated function runs.

    Settings of the caller that would change what is computed are suspended, too: another default
    dtype than float32, PyTorch's inference mode, and NumPy's errors as exceptions.
    """

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        with ExitStack() as settings:
            settings.callback(torch.set_num_threads, torch.get_num_threads())
            torch.set_num_threads(1)
            if torch.get_default_dtype() != torch.float32:
                settings.callback(torch.set_default_dtype, torch.get_default_dtype())
                torch.set_default_dtype(torch.float32)
            if torch.is_inference_mode_enabled():
                settings.enter_context(torch.inference_mode(False))
            if "raise" in np.geterr().values():
                settings.enter_context(np.errstate(all="warn", under="ignore"))
            return function(*args, **kwargs)

    return wrapped


def opencv_on_one_thread() -> None:
    """Limit OpenCV to the caller's thread, process-wide: our own threads use the cores."""
    import cv2

    cv2.setNumThreads(1)
