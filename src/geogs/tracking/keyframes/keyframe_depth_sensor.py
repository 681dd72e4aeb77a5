"""A depth sensor in the tracker: what it says of a keyframe's cells."""

import torch

from geogs.bundle.device_choice import grid_fields
from geogs.config import DepthSensorConfig
from geogs.priors.depth_sensor import sensor_depth
from geogs.types import MeasuredDepth
from geogs.world.cell_depths import MeasuredCells
from geogs.world.grid import OFFSET, STRIDE, SampleGrid
from geogs.world.keyframes import Keyframe


class KeyframeDepthSensor:
    """Gives keyframes the depth that a sensor measured, in metres."""

    def __init__(self, grid: SampleGrid, config: DepthSensorConfig) -> None:
        self.grid = grid
        self.config = config

    def start(self, keyframe: Keyframe, depth: MeasuredDepth | None, least: float) -> bool:
        """Give a first keyframe depths; False, and nothing done, where too few are known.

        Cells that the sensor does not know are filled from those around, without information.
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
        """Let a new keyframe know what was measured, over the depth it was given by others."""
        measured = self._measure(keyframe, depth)
        if measured is None:
            return
        known = measured.information > 0
        depths = torch.where(known, measured.inverse_depth, keyframe.inverse_depth)
        information = torch.where(known, measured.information, keyframe.information)
        keyframe.inverse_depth = grid_fields(self.grid).fill(depths, information)
        keyframe.information = information

    def _measure(self, keyframe: Keyframe, depth: MeasuredDepth | None) -> MeasuredCells | None:
        """Keep the picture and what it says of the cells, which is returned, if there is one."""
        metres = None if depth is None else depth.metres()
        if metres is None:
            return None
        keyframe.sensor_depth = metres
        grid = self.grid
        cells = sensor_depth(metres, self.config).at_cells(OFFSET, STRIDE, grid.height, grid.width)
        inverse_depth, information = (m.reshape(-1) for m in cells.tensors(grid.device))
        keyframe.measured = MeasuredCells(inverse_depth, information)
        return keyframe.measured
