"""The caster for a device."""

import torch

from geogs_synth.raycast.cpu_caster import CpuCaster
from geogs_synth.raycast.cuda_caster import CudaCaster


def caster_for(device: torch.device) -> CpuCaster:
    """Return the caster for rooms whose tensors are on the device."""
    return CudaCaster() if device.type == "cuda" else CpuCaster()
