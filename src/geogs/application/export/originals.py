"""The images of a run at full size, undistorted, for its keyframes."""

from collections.abc import Iterator
from dataclasses import fields

import numpy as np
from jaxtyping import UInt8

from geogs.application.results.saved_result import SavedResult
from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.guard.documents import UNUSABLE, read_yaml
from geogs.io.sources.frame_source import Source
from geogs.io.sources.sniff import open_source

_KEPT = ("take", "start", "stop", "stride", "field_of_view", "topic")
"""Settings of reading that decide which frames there are, and what of them."""


def open_originals(result: SavedResult, paths: tuple[str, ...]) -> Source:
    """Open what a run read: straight frames at full size, by its final lens and readout.

    Raises:
        InputError: it is not what the run read, or the result is not that of a run.
    """
    config = result.folder / "config.yaml"
    try:
        said = read_yaml(config)["input"]
        known = {f.name: said[f.name] for f in fields(InputConfig) if f.name in _KEPT}
        shutter = result.summary["shutter"]["readout"]
        fingerprint = result.summary["fingerprint"]
    except UNUSABLE:
        raise InputError(
            f"{result.folder} is no result of geogs run, whose images --images exports; leave it "
            "out."
        ) from None
    settings = InputConfig(
        intrinsics=str(result.folder / "intrinsics.json"), long_edge=0, poses="none",
        mask_overlay=False, readout=float(shutter), **known,
    )  # fmt: skip
    source = open_source(paths, settings)
    if source.fingerprint() != fingerprint:
        raise InputError(
            f"{', '.join(paths)}: the run of {result.folder} read something else; give by --images "
            "the video or folder that it read."
        )
    return source.straight()


def keyframe_images(
    result: SavedResult, source: Source
) -> Iterator[tuple[int, UInt8[np.ndarray, "h w 3"]]]:
    """Index and image at full size of each keyframe, in order of time.

    Raises:
        InputError: the source has no image at the time of one.
    """
    times = result.views.timestamp
    left = iter(np.argsort(times, kind="stable").tolist())
    number = next(left, None)
    for frame in source:
        if number is None:
            return
        if abs(frame.timestamp - times[number]) < 1e-6:
            yield number, frame.image
            number = next(left, None)
    if number is not None:
        raise InputError(f"The source has no image at {times[number]:.3f} s, as the run had.")
