"""Where poses and inverse depths are adjusted: on the CPU, or on the GPU that holds the depths."""

from geogs.bundle.base import BundleSolver
from geogs.keyframes.grid import SampleGrid


def bundle_solver(grid: SampleGrid) -> BundleSolver:
    """The solver for the device of a grid."""
    if grid.on_gpu:
        from geogs.bundle.cuda.dense import CudaDenseBundle

        return CudaDenseBundle(grid)
    from geogs.bundle.dense import DenseBundle

    return DenseBundle(grid)
