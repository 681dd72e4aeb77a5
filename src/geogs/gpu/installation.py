"""State of CUDA on this machine, determined without starting a GPU."""

import ctypes
import functools
import warnings
from pathlib import Path

import torch

from geogs.errors import DeviceError

_KERNEL_MODULE = Path("/proc/driver/nvidia/version")


@functools.cache
def driver_cuda() -> tuple[int, int] | None:
    """Newest CUDA version that the NVIDIA driver supports; None where there is no driver."""
    try:
        cuda = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return None
    version = ctypes.c_int()
    if cuda.cuDriverGetVersion(ctypes.byref(version)) or version.value == 0:
        return None
    return version.value // 1000, version.value % 1000 // 10


def driver_release() -> str | None:
    """The driver's own version such as 580.65.06; None if it cannot be read."""
    try:
        management = ctypes.CDLL("libnvidia-ml.so.1")
    except OSError:
        return None
    text = ctypes.create_string_buffer(96)
    if management.nvmlInit_v2():
        return None
    try:
        failed = management.nvmlSystemGetDriverVersion(text, len(text))
    finally:
        management.nvmlShutdown()
    return None if failed else text.value.decode()


def gpu_problem() -> str | None:
    """One sentence on why PyTorch cannot use an NVIDIA GPU here and what to do, None if it can."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # PyTorch's own message on an old driver; ours follows
        available = torch.version.cuda is not None and torch.cuda.is_available()
    if available:
        return None
    supported = driver_cuda()
    built = torch.version.cuda
    has_driver = supported is not None or _KERNEL_MODULE.exists()
    if not has_driver:
        build = "" if built else " and a CUDA build of PyTorch"
        return f"There is no NVIDIA driver on this machine; a GPU needs one{build}."
    if built is None:
        return (
            f"This machine has an NVIDIA driver, but this PyTorch ({torch.__version__}) was built "
            "without CUDA; install a CUDA build of PyTorch."
        )
    if supported is not None and supported[0] < int(built.split(".")[0]):
        return (
            f"The NVIDIA driver supports CUDA {supported[0]}.{supported[1]}, but this PyTorch was "
            f"built for CUDA {built}; update the driver or install a PyTorch built for CUDA "
            f"{supported[0]}."
        )
    return (
        "There is an NVIDIA driver but PyTorch finds no GPU; see whether nvidia-smi lists one and "
        "whether CUDA_VISIBLE_DEVICES hides it."
    )


def require_device(device: str | torch.device) -> torch.device:
    """The device named ``cpu``, ``cuda`` or ``cuda:1``; ``auto`` is a GPU where one can be used.

    Raises DeviceError if the device cannot be used.
    """
    name = str(device)
    if name == "auto":
        name = "cpu" if gpu_problem() else "cuda"
    try:
        device = torch.device(name)
    except RuntimeError:
        raise DeviceError(f"There is no device {name}; use cpu, cuda or cuda:0.") from None
    if device.type not in ("cpu", "cuda"):
        raise DeviceError(f"There is no backend for {name}; use cpu or cuda.")
    if device.type == "cpu":
        return device
    if problem := gpu_problem():
        raise DeviceError(f"{problem} Until then use --device cpu.")
    count = torch.cuda.device_count()
    index = device.index or 0
    if index >= count:
        raise DeviceError(f"There is no GPU {index}; this machine has {count}.")
    return torch.device("cuda", index)
