"""A depth sensor in the tracker: what it says of a keyframe's cells."""

from collections.abc import Sequence

import torch

from geogs.bundle.select import grid_fields
from geogs.config import DepthSensorConfig
from geogs.priors.depth_sensor import sensor_depth
from geogs.types import MeasuredDepth
from geogs.world.grid import OFFSET, STRIDE, SampleGrid
from geogs.world.keyframes import Keyframe, MeasuredCells


class DepthSensing:
    """Gives keyframes the depth that a sensor measured, in metres."""

    def __init__(self, grid: SampleGrid, config: DepthSensorConfig) -> None:
        self.grid = grid
        self.config = config

    def start(self, state: Keyframe, depth: MeasuredDepth | None, least: float) -> bool:
        """Give a first keyframe depths; False, and nothing done, where less than a share is known.

        Cells that the sensor does not know are filled from those around, without information.
        """
        if not self._look(state, depth):
            return False
        measured = state.measured
        assert measured is not None
        state.inverse_depth, state.information = measured.inverse_depth, measured.information
        if float(state.has_known_depth.float().mean()) < least:
            state.measured = None
            return False
        fields = grid_fields(self.grid)
        state.inverse_depth = fields.fill(measured.inverse_depth, measured.information)
        return True

    def join(self, state: Keyframe, depth: MeasuredDepth | None) -> None:
        """Let a new keyframe know what was measured, over the depth it was given by others."""
        if not self._look(state, depth):
            return
        measured = state.measured
        assert measured is not None
        known = measured.information > 0
        depths = torch.where(known, measured.inverse_depth, state.inverse_depth)
        information = torch.where(known, measured.information, state.information)
        state.inverse_depth = grid_fields(self.grid).fill(depths, information)
        state.information = information

    def _look(self, state: Keyframe, depth: MeasuredDepth | None) -> bool:
        """Keep the picture and what it says of the cells; False where there is none."""
        metres = None if depth is None else depth.metres()
        if metres is None:
            return False
        state.sensor_depth = metres
        grid = self.grid
        cells = sensor_depth(metres, self.config).at_cells(OFFSET, STRIDE, grid.height, grid.width)
        inverse_depth, information = (m.reshape(-1) for m in cells.tensors(grid.device))
        state.measured = MeasuredCells(inverse_depth, information)
        return True


def stands_alone(keyframes: Sequence[Keyframe]) -> bool:
    """Whether the second of three keyframes is the only one of them whose depth was measured."""
    before, middle, after = keyframes
    return middle.measured is not None and before.measured is None and after.measured is None
