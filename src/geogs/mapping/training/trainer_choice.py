"""Choice of the map's trainer: on the CPU, or on the GPU that holds the map."""

from typing import TYPE_CHECKING

from geogs.config import MappingConfig
from geogs.mapping.view_arrays import MapCameras
from geogs.world.disks import GaussianMap

if TYPE_CHECKING:
    from geogs.mapping.training.cpu import CpuTrainer
    from geogs.mapping.training.cuda.trainer import CudaTrainer

    MapTrainer = CpuTrainer | CudaTrainer


def map_trainer(
    disks: GaussianMap, cameras: MapCameras, config: MappingConfig, unit: float, resident: int
) -> "MapTrainer":
    """The trainer of the device that holds the map; a GPU has ``resident`` views at hand.

    A GPU trains in fused kernels, a CPU in compiled ones.
    """
    if disks.device.type == "cuda":
        from geogs.mapping.training.cuda.trainer import CudaTrainer

        return CudaTrainer(disks, cameras, config, unit, resident)
    from geogs.mapping.training.cpu import CpuTrainer

    return CpuTrainer(disks, cameras, config, unit)
