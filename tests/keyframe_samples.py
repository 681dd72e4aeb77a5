"""Keyframes as a tracker would leave them in its store."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from geogs.config import LossConfig
from geogs.geometry.camera import Camera
from geogs.mapping.keyframe_views import KeyframeViews
from geogs.mapping.view_arrays import MapCameras, ViewArrays
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import Keyframe, KeyframeSet, KeyframeTable
from geogs.world.map import MapTable


@dataclass(frozen=True, eq=False)
class Sample:
    """Parts of a keyframe; without depth it has unit depth."""

    frame_index: int
    image: UInt8[np.ndarray, "h w 3"]
    T_cw: Float[Tensor, "4 4"]
    inverse_depth: Float[Tensor, "gh gw"] | None = None
    information: Float[Tensor, "gh gw"] | None = None


def segment_of(
    samples: Sequence[Sample],
    camera: Camera,
    device: torch.device | str = "cpu",
    resident: int = 128,
) -> KeyframeSet:
    """A segment of a new store that holds them, ids from 0."""
    segment = KeyframeTable.on(SampleGrid(camera, device), None, resident).new_set()
    for sample in samples:
        add(segment, sample)
    return segment


def views_of(keyframes: KeyframeTable, cameras: MapCameras, loss: LossConfig) -> KeyframeViews:
    """Views of a map without disks, which know none of the keyframes yet."""
    table = MapTable.empty(keyframes.grid.device)
    return KeyframeViews(ViewArrays(table, keyframes, cameras, loss))


def add(segment: KeyframeSet, sample: Sample) -> Keyframe:
    """Append a keyframe."""
    keyframe = segment.add(
        sample.frame_index, sample.frame_index / 30, sample.image, None, sample.T_cw
    )
    device = segment.grid.device
    if sample.inverse_depth is not None:
        keyframe.inverse_depth = sample.inverse_depth.reshape(-1).float().to(device)
    if sample.information is not None:
        keyframe.information = sample.information.reshape(-1).float().to(device)
    return keyframe
