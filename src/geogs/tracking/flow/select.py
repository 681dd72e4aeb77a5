"""Which flow operator the tracker uses."""

from geogs.config import TrackingConfig
from geogs.networks.weights_files import find_weights
from geogs.tracking.flow.base import FlowOperator
from geogs.world.grid import SampleGrid


def build_operator(config: TrackingConfig, grid: SampleGrid) -> FlowOperator:
    """The operator that the configuration names, with its weights, for the device of a grid.

    Raises InputError if weights are needed and none are found or they do not fit.
    """
    if config.operator in ("auto", "classical"):
        return _classical(grid)
    if config.operator == "own":
        from geogs.tracking.flow.own import OwnFlow

        return OwnFlow(grid, find_weights("own", config.weights), _classical(grid))
    from geogs.tracking.flow.droid import DroidFlow

    return DroidFlow(grid, find_weights("droid", config.weights))


def _classical(grid: SampleGrid) -> FlowOperator:
    """The operator without a network."""
    if grid.on_gpu:
        from geogs.tracking.flow.classical_cuda import CudaClassicalFlow

        return CudaClassicalFlow(grid)
    from geogs.tracking.flow.classical import ClassicalFlow

    return ClassicalFlow(grid)
