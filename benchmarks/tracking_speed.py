"""Speed of tracking alone with our flow network, and what DROID-SLAM's network would cost.

    python benchmarks/tracking_speed.py SOURCE [--size 616 344] [--frames 400] [--device cuda]

The tracker follows the frames with the operator ``own``. In a second pass a DROID-SLAM network (its
weights are random: they change nothing of its speed) is run on every call that the tracker makes,
and only its time is taken; the tracker goes on with what ``own`` found. Printed are frames per
second of tracking with either, without the reading of images.
"""

import argparse
import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from geogs.config import Config, InputConfig, TrackingConfig
from geogs.geometry.camera import Camera
from geogs.io.sources.sniff import open_source
from geogs.threads import on_one_torch_thread
from geogs.tracking.flow.droid import DroidFlow
from geogs.tracking.flow.droid_network import DroidNetwork
from geogs.tracking.flow.flow_operator import FlowOperator, Memories
from geogs.tracking.flow.operator_choice import build_operator
from geogs.tracking.tracker import lone_tracker
from geogs.types import FlowMatch, Frame
from geogs.world.grid import SampleGrid


class Shadowed:
    """An operator, with another one run on the same calls; both are timed."""

    def __init__(self, main: FlowOperator, shadow: FlowOperator | None, device: str) -> None:
        self.main, self.shadow, self._device = main, shadow, device
        self.seconds = {"main": 0.0, "shadow": 0.0}

    def encode(self, image: np.ndarray) -> Any:
        shadow = self.shadow
        second = None if shadow is None else self._timed("shadow", lambda: shadow.encode(image))
        return self._timed("main", lambda: self.main.encode(image)), second

    def texture(self, encoded: Any) -> float:
        return self.main.texture(encoded[0])

    def grey(self, encoded: Any) -> torch.Tensor:
        return self.main.grey(encoded[0])

    def measure(
        self,
        first: Sequence[Any],
        second: Sequence[Any],
        forward: torch.Tensor | None = None,
        backward: torch.Tensor | None = None,
        fine: bool = True,
        memory: Memories | None = None,
    ) -> tuple[FlowMatch, FlowMatch]:
        sides = [[[i[k] for i in side] for side in (first, second)] for k in (0, 1)]
        shadow = self.shadow
        if shadow is not None:
            other = shadow
            self._timed("shadow", lambda: other.measure(*sides[1], forward, backward, fine))
        return self._timed("main", lambda: self.main.measure(*sides[0], forward, backward, fine))

    def _timed(self, name: str, work: Callable[[], Any]) -> Any:
        if self.shadow is None:
            return work()
        _wait(self._device)
        start = time.perf_counter()
        found = work()
        _wait(self._device)
        self.seconds[name] += time.perf_counter() - start
        return found


@on_one_torch_thread
def track(camera: Camera, frames: list[np.ndarray], device: str, shadow: bool) -> tuple[float, Any]:
    """Seconds of tracking, and the operator with its own times."""
    grid = SampleGrid(camera, device)
    config = TrackingConfig(operator="own")
    droid = DroidFlow(grid, DroidNetwork()) if shadow else None
    operator = Shadowed(build_operator(config, grid), droid, device)
    warm = [operator.encode(frames[k]) for k in (0, 5)]
    operator.measure(warm[:1], warm[1:])
    tracker = lone_tracker(camera, Config(tracking=config), device, operator=operator)
    operator.seconds = dict.fromkeys(operator.seconds, 0.0)
    _wait(device)
    start = time.perf_counter()
    for k, image in enumerate(frames):
        tracker.track(Frame(k, k / 30, image))
    tracker.finish()
    _wait(device)
    seconds = time.perf_counter() - start
    print(
        f"{len(tracker.segment.ids)} keyframes, {len(frames)} frames, "
        f"state {tracker.segment.status.state.value}"
    )
    return seconds, operator


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path)
    parser.add_argument("--size", type=int, nargs=2, default=(616, 344))
    parser.add_argument("--frames", type=int, default=400)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    options = parser.parse_args()
    source = open_source(options.source, InputConfig(stop=options.frames))
    width, height = options.size
    frames = [cv2.resize(f.image, (width, height)) for f in source]
    x, y = width / source.camera.width, height / source.camera.height
    camera = dataclasses.replace(
        source.camera, fx=source.camera.fx * x, fy=source.camera.fy * y, width=width, height=height,
        cx=(source.camera.cx + 0.5) * x - 0.5, cy=(source.camera.cy + 0.5) * y - 0.5,
    )  # fmt: skip
    alone, _ = track(camera, frames, options.device, shadow=False)
    with_both, operator = track(camera, frames, options.device, shadow=True)
    own, droid = operator.seconds["main"], operator.seconds["shadow"]
    print(f"own:   {len(frames) / alone:.1f} frames/s, of which the operator takes {own:.2f} s")
    instead = with_both - own
    print(f"droid: {len(frames) / instead:.1f} frames/s, of which the operator takes {droid:.2f} s")


def _wait(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


if __name__ == "__main__":
    main()
