"""Choice of the tracker's flow operator."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from geogs.config import TrackingConfig
from geogs.networks.weights_files import find_weights, located, weights_folders
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.tracking.flow.masked import MaskedFlow
from geogs.world.grid import SampleGrid


def build_operator(
    config: TrackingConfig,
    grid: SampleGrid,
    mask: Bool[np.ndarray, "h w"] | None = None,
    black_is_masked: bool = False,
) -> FlowOperator:
    """Build the configured operator, with its weights, for the device of a grid.

    Pixels outside a ``mask``, true where all images show the scene, are not matched, nor black ones
    with ``black_is_masked``. Raises InputError if weights are needed and none are found or they do
    not fit, or if the mask does not fit.
    """
    operator = _operator(config, grid)
    if mask is not None:
        operator = MaskedFlow(operator, grid, mask)
    return MaskedFlow(operator, grid) if black_is_masked else operator


def operator_found(config: TrackingConfig) -> str | None:
    """Describe the operator chosen by ``droid_if_found``, and why; None for other settings."""
    if config.operator != "droid_if_found":
        return None
    found = _resolved(config)
    if found.operator == "droid":
        return f"image motion is measured by DROID-SLAM's network, {found.weights}."
    places = ", ".join(map(str, weights_folders()))
    return (
        "image motion is measured by the classical operator, as there is no droid.pth of "
        f"DROID-SLAM's in {places}."
    )


def _resolved(config: TrackingConfig) -> TrackingConfig:
    """Replace ``droid_if_found`` by the operator for which files exist."""
    if config.operator != "droid_if_found":
        return config
    weights = config.weights or located("droid")
    if weights is None:
        return replace(config, operator="classical")
    return replace(config, operator="droid", weights=str(weights))


def _operator(config: TrackingConfig, grid: SampleGrid) -> FlowOperator:
    config = _resolved(config)
    if config.operator in ("auto", "classical"):
        return _classical(grid)
    if config.operator == "own":
        from geogs.tracking.flow.own import OwnFlow

        return OwnFlow(grid, find_weights("own", config.weights), _classical(grid))
    from geogs.networks.tensor_files import read_tensors
    from geogs.tracking.flow.droid import DroidFlow
    from geogs.tracking.flow.droid_network import load_droid

    return DroidFlow(grid, load_droid(read_tensors(find_weights("droid", config.weights))))


def _classical(grid: SampleGrid) -> FlowOperator:
    """Return the operator without a network."""
    if grid.on_gpu:
        from geogs.tracking.flow.classical_flow_cuda import CudaClassicalFlow

        return CudaClassicalFlow(grid)
    from geogs.tracking.flow.classical_flow import ClassicalFlow

    return ClassicalFlow(grid)
