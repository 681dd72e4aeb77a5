"""Choice of the device for poses and fields: the CPU, or the GPU of the depths."""

from collections.abc import Sequence

from jaxtyping import Int
from torch import Tensor

from geogs.bundle.fields import GridFields
from geogs.bundle.keyframe_pairs import KeyframePairs
from geogs.bundle.motion_only import MotionSolver
from geogs.bundle.problem import BundleProblem, StreamedProblem
from geogs.bundle.protocols import BundleSolver
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet


def bundle_solver(grid: SampleGrid) -> BundleSolver[BundleProblem]:
    """Return the solver for the device of a grid."""
    if grid.on_gpu:
        from geogs.bundle.cuda.dense import CudaDenseBundle

        return CudaDenseBundle(grid)
    from geogs.bundle.dense import DenseBundle

    return DenseBundle(grid)


def large_bundle_solver(grid: SampleGrid) -> BundleSolver[StreamedProblem]:
    """Return the solver with bounded memory for the device of a grid."""
    if grid.on_gpu:
        from geogs.bundle.cuda.streamed import CudaStreamedBundle

        return CudaStreamedBundle(grid)
    from geogs.bundle.streamed import StreamedBundle

    return StreamedBundle(grid)


def motion_solver(grid: SampleGrid, cells: Int[Tensor, "p"] | None = None) -> MotionSolver:
    """Return the solver for the device of a grid; matches are those of some cells, or of all."""
    if grid.on_gpu:
        from geogs.bundle.cuda.motion_only import CudaMotion

        return CudaMotion(grid, cells)
    return MotionSolver(grid, cells)


def grid_fields(grid: SampleGrid) -> GridFields:
    """Return the operations on fields for the device of a grid."""
    if grid.on_gpu:
        from geogs.bundle.cuda.fields import CudaFields

        return CudaFields(grid)
    return GridFields(grid)


def keyframe_pairs(keyframes: KeyframeSet, directed: Sequence[tuple[int, int]]) -> KeyframePairs:
    """Return pairs (source, target) of keyframe ids, on their device."""
    if keyframes.grid.on_gpu:
        from geogs.bundle.cuda.keyframe_pairs import CudaPairs

        return CudaPairs(keyframes, directed)
    return KeyframePairs(keyframes, directed)
