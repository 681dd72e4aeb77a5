"""Depth sensors in the tracker: depths of a keyframe's cells."""

import torch

from geogs.bundle.device_choice import grid_fields
from geogs.config import DepthSensorConfig
from geogs.priors.depth_sensor import sensor_depth
from geogs.types import MeasuredDepth
from geogs.world.cell_depths import MeasuredCells
from geogs.world.grid import OFFSET, STRIDE, SampleGrid
from geogs.world.keyframes import Keyframe


class KeyframeDepthSensor:
    """Sets sensor depths of keyframes, in metres."""

    def __init__(self, grid: SampleGrid, config: DepthSensorConfig) -> None:
        self.grid = grid
        self.config = config

    def start(self, keyframe: Keyframe, depth: MeasuredDepth | None, least: float) -> bool:
        """Set the depths of a first keyframe; False, without changes, where too few are known.

        Cells without sensor depth are filled from those around, without information.
        """
        measured = self._measure(keyframe, depth)
        if measured is None:
            return False
        keyframe.inverse_depth, keyframe.information = measured.inverse_depth, measured.information
        if float(keyframe.has_known_depth.float().mean()) < least:
            keyframe.measured = None
            return False
        fields = grid_fields(self.grid)
        keyframe.inverse_depth = fields.fill(measured.inverse_depth, measured.information)
        return True

    def join(self, keyframe: Keyframe, depth: MeasuredDepth | None) -> None:
        """Set sensor depths of a new keyframe, in place of propagated ones."""
        measured = self._measure(keyframe, depth)
        if measured is None:
            return
        known = measured.information > 0
        depths = torch.where(known, measured.inverse_depth, keyframe.inverse_depth)
        information = torch.where(known, measured.information, keyframe.information)
        keyframe.inverse_depth = grid_fields(self.grid).fill(depths, information)
        keyframe.information = information

    def _measure(self, keyframe: Keyframe, depth: MeasuredDepth | None) -> MeasuredCells | None:
        """Store the depth image, if any, and return its values at the cells."""
        metres = None if depth is None else depth.metres()
        if metres is None:
            return None
        keyframe.sensor_depth = metres
        grid = self.grid
        cells = sensor_depth(metres, self.config).at_cells(OFFSET, STRIDE, grid.height, grid.width)
        inverse_depth, information = (m.reshape(-1) for m in cells.tensors(grid.device))
        keyframe.measured = MeasuredCells(inverse_depth, information)
        return keyframe.measured
