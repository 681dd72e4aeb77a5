"""A run's whole state as a stream of bytes, to go on from later with the same result.

The state is the graph of objects under a :class:`Slam`, written by Python's pickle with two limits.
What belongs to the process rather than to the run (the flow operator, kernels, threads) is not
written, but taken from the system that reads. And reading makes nothing but the system's own
records, arrays and a few plain containers, so that a foreign file does no harm.

A new attribute is stored like all others. One that cannot be is left out by ``__getstate__`` and
made again by ``__setstate__`` of its class, or named here.
"""

import pickle
from collections.abc import Callable
from importlib import import_module
from types import MethodType
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np
import torch
from torch import Tensor

from geogs.bundle.select import bundle_solver
from geogs.config import MappingConfig
from geogs.depth.select import depth_engine
from geogs.errors import InputError
from geogs.keyframes.archive import Archive, Archived, NamedFiles, SettledArchive
from geogs.keyframes.grid import SampleGrid
from geogs.mapping.cameras import MapCameras
from geogs.mapping.training.base import MapTrainer
from geogs.mapping.training.select import map_trainer
from geogs.slam import Slam
from geogs.splat.map import GaussianMap
from geogs.splat.optimizer import MapOptimizer
from geogs.tracking.segments import Segments

PROTOCOL = 5
_PROCESS = frozenset({"config", "camera", "device", "prior", "operator", "ids"})
"""Attributes of a Slam that the one who reads has already."""
_PACKAGES = (
    "keyframes", "bundle", "depth", "config", "geometry", "losses", "mapping", "priors.base",
    "loop", "splat",
    "stopwatch", "tracking", "types",
)  # fmt: skip
"""Modules of ours whose classes may be in a state."""
_PLAIN = frozenset({
    ("builtins", "bytearray"), ("builtins", "frozenset"), ("builtins", "set"),
    ("collections", "OrderedDict"), ("collections", "deque"),
    ("numpy", "dtype"), ("numpy", "ndarray"),
    ("pathlib", "PosixPath"), ("pathlib", "WindowsPath"),
    *((f"numpy.{core}.{name}", made) for core in ("core", "_core") for name, made in (
        ("multiarray", "_reconstruct"), ("multiarray", "scalar"), ("numeric", "_frombuffer"),
    )),
})  # fmt: skip
"""What else may be in one."""
_FOLDER = object()
"""Stands for the folder of the archives."""


@runtime_checkable
class ByteSink(Protocol):
    """What can be written to."""

    def write(self, data: bytes, /) -> int:
        """As of a binary file."""
        ...


@runtime_checkable
class ByteSource(Protocol):
    """What can be read from."""

    def read(self, size: int, /) -> bytes:
        """As of a binary file."""
        ...

    def readline(self) -> bytes:
        """As of a binary file."""
        ...


def write_slam(stream: ByteSink, slam: Slam, folder: NamedFiles) -> list[Archive]:
    """Write a system between two frames; its archives lie in ``folder`` from now on.

    Returns the archives, to be released once the state is safe. What the flow operator remembers of
    edges is left out (operators without a memory, such as the classical, lose nothing).

    Raises:
        OutputError: an archive cannot be written.
    """
    slam.mapper.pool.store()
    writer = _Writer(stream, slam, folder)
    writer.dump({name: x for name, x in vars(slam).items() if name not in _PROCESS})
    return writer.archives


def read_slam(stream: ByteSource, slam: Slam, folder: NamedFiles) -> None:
    """Give a new system, made with the same camera and settings, the state that was written.

    Raises:
        InputError: it is damaged, or was written by another version.
    """
    state = read_record(stream, dict, slam, folder)
    missing = vars(slam).keys() - state.keys() - _PROCESS
    if missing or state.keys() & _PROCESS:
        raise InputError("the state is of another version")
    vars(slam).update(state)


def write_record(stream: ByteSink, record: object) -> None:
    """Write a frozen record of plain values."""
    _Writer(stream).dump(record)


def read_record(
    stream: ByteSource,
    kind: type,
    slam: Slam | None = None,
    folder: NamedFiles | None = None,
    more: frozenset[tuple[str, str]] = frozenset(),
) -> Any:
    """Read a record of a kind; ``more`` are modules and names of classes that may be in it.

    Raises:
        InputError: it is damaged, foreign, or was written by another version.
    """
    try:
        record = _Reader(stream, slam, folder, more).load()
    except InputError:
        raise
    except Exception as error:  # whatever rubbish may lead to
        raise InputError(str(error) or type(error).__name__) from error
    if not isinstance(record, kind):
        raise InputError("it holds something else")
    return record


class _Writer(pickle.Pickler):
    """Leaves out what belongs to the process."""

    def __init__(
        self, stream: ByteSink, slam: Slam | None = None, folder: NamedFiles | None = None
    ) -> None:
        super().__init__(stream, PROTOCOL)
        self.folder = folder
        self.archives: list[Archive] = []
        self._slam = slam
        named = {"slam": slam, "operator": slam and slam.operator, "prior": slam and slam.prior}
        self._parts = {id(part): name for name, part in named.items() if part is not None}

    def persistent_id(self, obj: object) -> Any:
        """The name of what the reader has already; None for what is written."""
        if isinstance(obj, SampleGrid):
            return ("grid",)
        if isinstance(obj, torch.device):
            return ("device", "cpu" if obj.type == "cpu" else "run")
        if obj is _FOLDER:
            return ("folder",)
        if self._slam is not None and obj is self._slam.ids:
            return ("ids", self._slam.ids.next)
        if isinstance(obj, MethodType) and id(obj.__self__) in self._parts:
            return ("method", self._parts[id(obj.__self__)], obj.__name__)
        name = self._parts.get(id(obj))
        return None if name is None else (name,)

    def reducer_override(self, obj: Any) -> Any:
        """How to make again what pickle knows nothing of."""
        if isinstance(obj, Tensor):
            return tensor_of, _parts_of_tensor(obj)
        if isinstance(obj, Archive):
            assert self.folder is not None, "no folder for archives"
            self.archives.append(obj)
            return reopened, (_FOLDER, obj.name, obj.settle(self.folder))
        make = _MAKERS.get(type(obj).__name__)
        return NotImplemented if make is None else make(obj)


class _Reader(pickle.Unpickler):
    """Makes only what may be in a state."""

    def __init__(
        self,
        stream: ByteSource,
        slam: Slam | None,
        folder: NamedFiles | None,
        more: frozenset[tuple[str, str]],
    ) -> None:
        super().__init__(stream)
        self._slam, self._folder, self._more = slam, folder, more

    def find_class(self, module: str, name: str) -> Any:
        """A class that may be in a state, or a function that makes what pickle cannot."""
        if (module, name) in _FUNCTIONS:
            return _FUNCTIONS[module, name]
        if (module, name) in _PLAIN | self._more:
            return getattr(import_module(module), name)
        if any(module == f"geogs.{p}" or module.startswith(f"geogs.{p}.") for p in _PACKAGES):
            found = getattr(import_module(module), name)
            if isinstance(found, type):
                return found
        raise InputError(f"{module}.{name} has no place in it")

    def persistent_load(self, pid: Any) -> Any:
        """What the process that reads has already."""
        slam, (what, *rest) = self._slam, pid
        if slam is None:
            raise InputError(f"{what} has no place in it")
        if what == "device":
            return torch.device("cpu" if rest == ["cpu"] else slam.device)
        if what == "ids":
            slam.ids.next = int(rest[0])
            return slam.ids
        if what == "method":
            return {
                ("slam", "new_tracker"): slam.new_tracker,
                ("operator", "encode"): slam.operator.encode,
            }[tuple(rest)]
        return {
            "grid": slam.segments.world.grid, "folder": self._folder, "operator": slam.operator,
            "prior": slam.prior,
        }[what]  # fmt: skip


# --- what pickle knows nothing of --------------------------------------------------------------


def tensor_of(
    array: np.ndarray, device: torch.device, requires_grad: bool, is_brain_float: bool
) -> Tensor:
    """A tensor of its own memory on a device."""
    tensor = torch.tensor(array)
    if is_brain_float:
        tensor = tensor.view(torch.bfloat16)
    return tensor.to(device).requires_grad_(requires_grad)


def _parts_of_tensor(x: Tensor) -> tuple[np.ndarray, torch.device, bool, bool]:
    is_brain_float = x.dtype == torch.bfloat16  # NumPy has none
    plain = x.detach().cpu()
    array = (plain.contiguous().view(torch.int16) if is_brain_float else plain).numpy()
    return array, x.device, x.requires_grad, is_brain_float


def reopened(folder: NamedFiles, name: str, settled: SettledArchive) -> Archive:
    """An archive of a state."""
    return Archive.reopened(folder, name, settled)


def archived_in(
    archive: Archive, offset: int, shape: tuple[int, ...], dtype: np.dtype, checksum: int
) -> Archived:
    """An array in an archive of a state."""
    return archive.piece(offset, shape, dtype, checksum)


def torch_generator(state: np.ndarray) -> torch.Generator:
    """PyTorch's random numbers from where they were."""
    generator = torch.Generator()
    generator.set_state(torch.from_numpy(state))
    return generator


def numpy_generator(state: dict[str, Any]) -> np.random.Generator:
    """NumPy's random numbers from where they were."""
    generator = np.random.default_rng()
    generator.bit_generator.state = state
    return generator


def hamming_matcher() -> cv2.BFMatcher:
    """The matcher of binary descriptors."""
    return cv2.BFMatcher(cv2.NORM_HAMMING)


def store_of(segments: Segments) -> Callable:
    """What says where a keyframe is."""
    return segments.store_of


def trainer_of(
    disks: GaussianMap,
    cameras: MapCameras,
    config: MappingConfig,
    unit: float,
    optimizer: MapOptimizer,
) -> MapTrainer:
    """A trainer of the device that holds the map, with the optimiser that there was."""
    trainer = map_trainer(disks, cameras, config, unit)
    trainer.optimizer = optimizer
    return trainer


def _method(method: MethodType) -> Any:
    owner = method.__self__
    if isinstance(owner, Segments) and method.__name__ == "store_of":
        return store_of, (owner,)
    raise TypeError(f"{method!r} cannot be stored; name it in {__name__}")


_MAKERS: dict[str, Callable[[Any], Any]] = {
    "Generator": lambda g: (
        (torch_generator, (g.get_state().numpy(),))
        if isinstance(g, torch.Generator)
        else (numpy_generator, (g.bit_generator.state,))
    ),
    "Archived": lambda a: (archived_in, (a.archive, a.offset, a.shape, a.dtype, a.checksum)),
    "BFMatcher": lambda _: (hamming_matcher, ()),
    "method": _method,
    **dict.fromkeys(
        ("Trainer", "CudaTrainer"),
        lambda t: (trainer_of, (t.disks, t.cameras, t.config, t.unit, t.optimizer)),
    ),
    **dict.fromkeys(("DenseBundle", "CudaDenseBundle"), lambda b: (bundle_solver, (b.grid,))),
    "CpuDepthEngine": lambda e: (
        depth_engine, (torch.device("cpu"), e.render, e.working, e.config),
    ),
    "CudaDepthEngine": lambda e: (depth_engine, (e.device, e.render, e.working, e.config)),
}  # fmt: skip
"""By the name of the class: function and arguments that make the object again."""

_FUNCTIONS: dict[tuple[str, str], Callable] = {
    (f.__module__, f.__name__): f
    for f in (
        tensor_of, reopened, archived_in, torch_generator, numpy_generator, hamming_matcher,
        store_of, trainer_of, bundle_solver, depth_engine,
    )
}  # fmt: skip
