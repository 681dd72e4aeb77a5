"""Work on a GPU recorded as a CUDA graph: its many launches cost the CPU a single one."""

import gc
import logging
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager

import torch
from torch import Tensor

_log = logging.getLogger(__name__)

Maps = tuple[Tensor, ...]
"""Results, on the device of the tensors they are made of."""


@contextmanager
def recording(device: torch.device) -> Generator[torch.cuda.CUDAGraph]:
    """A CUDA graph of what this thread launches on ``device`` within the block.

    Python's garbage collector is off meanwhile: an older graph that it destroyed would end the
    recording with an error. A recording that fails leaves the device's random generator in
    recording mode: it goes on with a copy of its state.
    """
    graph = torch.cuda.CUDAGraph()
    collects = gc.isenabled()
    gc.disable()
    try:
        with torch.cuda.device(device), torch.cuda.graph(graph, capture_error_mode="thread_local"):
            yield graph
    except RuntimeError:
        random = torch.cuda.default_generators[device.index or 0]
        random.graphsafe_set_state(random.clone_state())
        raise
    finally:
        if collects:
            gc.enable()


class Recorded:
    """Runs ``work``, whose control flow may not depend on the values of its tensors.

    On a GPU it is recorded as a CUDA graph at the second call with tensors of the same shapes, and
    replayed from then on: in the first call libraries still choose their kernels, and shapes that
    come only once are not worth it. Elsewhere, and where a driver cannot record it, it is called
    directly. Threads and streams may share one: each waits until the calls before are done.
    """

    def __init__(self, work: Callable[..., Maps], name: str) -> None:
        """``name`` is used in the warning if it cannot be recorded."""
        self._work = work
        self._name = name
        self._done_once = set[tuple[torch.Size, ...]]()
        self._recordings: dict[tuple[torch.Size, ...], Callable[..., Maps]] = {}
        self._lock = threading.Lock()
        self._done: torch.cuda.Event | None = None

    def __call__(self, *given: Tensor) -> Maps:
        """The result of ``work``."""
        if not given[0].is_cuda:
            return self._work(*given)
        shapes = tuple(tensor.shape for tensor in given)
        with self._lock:
            stream = torch.cuda.current_stream(given[0].device)
            if self._done is not None:
                stream.wait_event(self._done)
            if shapes in self._done_once and shapes not in self._recordings:
                self._recordings[shapes] = self._recording(given)
            self._done_once.add(shapes)
            found = self._recordings.get(shapes, self._work)(*given)
            self._done = stream.record_event(self._done)
        return found

    def _recording(self, given: Maps) -> Callable[..., Maps]:
        try:
            return _Recording(self._work, given)
        except torch.cuda.OutOfMemoryError:
            raise
        except RuntimeError as error:
            _log.warning("%s is slower than it could be: %s", self._name, error)
            return self._work


class _Recording:
    def __init__(self, work: Callable[..., Maps], given: Maps) -> None:
        self._given = tuple(tensor.clone() for tensor in given)
        with recording(given[0].device) as self._graph:
            self._found = work(*self._given)

    def __call__(self, *given: Tensor) -> Maps:
        for mine, tensor in zip(self._given, given, strict=True):
            mine.copy_(tensor)
        self._graph.replay()
        return tuple(found.clone() for found in self._found)
