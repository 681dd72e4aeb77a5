"""The network as a recorded sequence of kernels: its thousand launches cost the CPU one."""

import logging
from collections.abc import Callable
from dataclasses import fields

import torch
from torch import Tensor

from geogs.depth.network.views import StereoViews

_log = logging.getLogger(__name__)

Maps = tuple[Tensor, ...]
"""What is made of views, on their device."""


class RecordedSearch:
    """Does ``work``, which no value of the views may change the course of.

    On a GPU it is recorded as a CUDA graph at the first views of each number of neighbours, and
    played back from then on; the images are all of one size. Elsewhere, and where a driver cannot
    record it, it is called as it is.
    """

    def __init__(self, work: Callable[[StereoViews], Maps]) -> None:
        self._work = work
        self._recordings: dict[int, Callable[[StereoViews], Maps]] = {}

    def __call__(self, views: StereoViews) -> Maps:
        """What ``work`` returns."""
        if not views.image.is_cuda:
            return self._work(views)
        count = views.others.shape[1]
        if count not in self._recordings:
            self._recordings[count] = self._recorded(views)
        return self._recordings[count](views)

    def _recorded(self, views: StereoViews) -> Callable[[StereoViews], Maps]:
        try:
            return _Recording(self._work, views)
        except torch.cuda.OutOfMemoryError:
            raise
        except RuntimeError as error:
            _log.warning("The depth network is slower than it could be: %s", error)
            return self._work


class _Recording:
    def __init__(self, work: Callable[[StereoViews], Maps], views: StereoViews) -> None:
        self._views = StereoViews(*(getattr(views, f.name).clone() for f in fields(views)))
        device = views.image.device
        with torch.cuda.device(device):
            aside = torch.cuda.Stream()
            aside.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(aside):
                work(self._views)  # libraries choose their kernels
            torch.cuda.current_stream().wait_stream(aside)
            self._graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(self._graph, capture_error_mode="thread_local"):
                self._found = work(self._views)

    def __call__(self, views: StereoViews) -> Maps:
        for f in fields(views):
            getattr(self._views, f.name).copy_(getattr(views, f.name))
        self._graph.replay()
        return tuple(found.clone() for found in self._found)
