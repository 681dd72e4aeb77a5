"""``map.safetensors``: the disks, ten numbers each, and the views of the map."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from geogs.config.arguments import checks_arguments
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.guard.atomic import atomic_file
from geogs.guard.documents import UNUSABLE, require_file
from geogs.io.writers.intrinsics_file import camera_of
from geogs.limits import POSITIVE, RIGID, holds
from geogs.short_repr import ShortRepr
from geogs.types import MapSnapshot

FORMAT_VERSION = 2
"""Incremented where older programs cannot read the file; version 1 is all in the world frame."""

_SHAPES = {"position": (3,), "quaternion": (4,), "scale": (2,), "opacity": ()}
_OWN = {"position": "map_position", "scale": "map_scale"}
"""Names of tensors in the map's own frame, where that is not the world's."""
_OF_KEYFRAMES = {
    "id": torch.int64, "time": torch.float64, "T_cw": torch.float64, "has_mask": torch.bool
}  # fmt: skip
"""Tensors of the views by name, and their types; all others are float32."""
_NONE = torch.zeros(0, 0, 0)


@dataclass(frozen=True)
class MapFile:
    """Content of a map's file."""

    disks: MapSnapshot
    tensors: dict[str, Tensor]
    """All others, on the CPU."""
    metadata: dict[str, Any]


def save_map(path: str | Path, disks: MapSnapshot, metadata: Mapping[str, Any] = {}) -> None:
    """Write the disks in float32.

    Args:
        path: the file.
        disks: the map.
        metadata: anything JSON can hold, kept beside the disks.
    """
    _write(path, {name: getattr(disks, name).float() for name in _SHAPES}, metadata)


def _write(path: str | Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, Any]) -> None:
    header = {
        "format": "geogs-map",
        "version": "1" if "position" in tensors else str(FORMAT_VERSION),
        "metadata": json.dumps(dict(metadata)),
    }
    on_cpu = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    # The library would write the metadata in an order that differs between processes.
    data = memoryview(save(on_cpu))
    end = 8 + int.from_bytes(data[:8], "little")
    table = {"__metadata__": header, **json.loads(bytes(data[8:end]))}
    text = json.dumps(table, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    with atomic_file(path) as stream:
        stream.write(len(text).to_bytes(8, "little") + text)
        stream.write(data[end:])


@checks_arguments
def load_map(path: str | Path, device: torch.device | str = "cpu") -> MapSnapshot:
    """Read the disks of a map, in the world.

    Raises:
        InputError: the file is missing, damaged, no map, of a newer version, or holds NaN.
    """
    return load_map_file(path, device).disks


def load_map_file(path: str | Path, device: torch.device | str = "cpu") -> MapFile:
    """Read the disks of a map, in the world, and the data beside them.

    Raises:
        InputError: as of ``load_map``.
    """
    with _open(path) as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        metadata = _metadata(path, (file.metadata() or {}).get("metadata", "{}"))
    is_own = "position" not in tensors
    parts = {n: tensors.get(_OWN.get(n, n) if is_own else n, _NONE) for n in _SHAPES}
    for name, shape in _SHAPES.items():
        part = parts[name]
        if part.shape != (len(parts["position"]), *shape) or part.dtype is not torch.float32:
            raise InputError(
                f"{path} is no map of geogs: its {name} is missing or misshapen, or not of float32."
            )
    disks = MapSnapshot(**{name: part.to(device) for name, part in parts.items()})
    if is_own:
        try:
            disks = disks.in_world(*_frame(metadata["views"]))
        except UNUSABLE as error:
            raise InputError(f"{path} does not say where its disks are; was it changed?") from error
    if not disks.is_finite():
        raise InputError(f"{path} holds NaN or infinity; the map is damaged.")
    others = {name: tensor for name, tensor in tensors.items() if name not in _SHAPES}
    return MapFile(disks, others, metadata)


def _frame(views: dict[str, Any]) -> tuple[Float64[np.ndarray, "3"], float]:
    """Origin and unit of the map's own frame. Raises an error of ``UNUSABLE`` if they are none."""
    origin = np.array(views["origin"], np.float64).reshape(3)
    unit = float(views["unit"])
    if not (holds((), origin) and holds((POSITIVE,), unit)):
        raise ValueError("a number is not finite, or no length")
    return origin, unit


def _metadata(path: str | Path, text: str) -> dict[str, Any]:
    try:
        said = json.loads(text)
    except (ValueError, RecursionError):
        said = None
    if not isinstance(said, dict):
        raise InputError(f"{path} is damaged: what it says of itself cannot be understood.")
    return said


def _open(path: str | Path) -> "safe_open":
    if not Path(path).is_file():
        raise InputError(f"The map {path} does not exist.")
    try:
        file = safe_open(str(require_file(path)), framework="pt")
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path} is no map of geogs, or is damaged.") from error
    header = file.metadata() or {}
    if header.get("format") != "geogs-map":
        raise InputError(f"{path} is no map of geogs.")
    version = header.get("version", "")
    if not (version.isascii() and version.isdigit() and len(version) < 9):
        raise InputError(f"{path} is damaged: it does not say of which version it is.")
    if int(version) > FORMAT_VERSION:
        raise InputError(f"{path} was written by a newer geogs; update this one to read it.")
    return file


@dataclass(frozen=True, repr=False)
class MapViews(ShortRepr):
    """The keyframes for which depth maps are rendered, with the rendering parameters."""

    camera: Camera
    """Camera of the keyframes' images."""
    render_camera: Camera
    """Camera of the depth maps."""
    min_alpha: float
    """Opacity above which the map occludes."""
    max_spread: float
    """Largest relative difference of mean and median depth for a ray that meets one surface."""
    plane_reach: float
    """Largest relative distance for averaging a depth over the planes of neighbouring pixels."""
    origin: Float64[np.ndarray, "3"]
    """World coordinates of the origin of the map's own frame."""
    unit: float
    """Length of a unit of the map's own frame in the world."""
    disks: MapSnapshot
    """In the map's own frame, in which they are rendered."""
    keyframe_id: Int64[np.ndarray, "k"]
    timestamp: Float64[np.ndarray, "k"]
    """Seconds."""
    T_cw: Float64[np.ndarray, "k 4 4"]
    """World to camera."""
    has_mask: Bool[np.ndarray, "k"]
    """Whether a keyframe has a mask, in ``keyframes/``."""
    has_images: bool
    """Whether the images are kept, in ``keyframes/``."""

    def rotated(self, R: Float64[np.ndarray, "3 3"]) -> "MapViews":
        """The same views in a world that ``R`` maps this one to."""
        T_cw = self.T_cw.copy()
        T_cw[:, :3, :3] = T_cw[:, :3, :3] @ R.T
        return replace(self, origin=R @ self.origin, disks=self.disks.rotated(R), T_cw=T_cw)


def save_map_with_views(
    path: str | Path, views: MapViews, metadata: Mapping[str, Any] = {}
) -> None:
    """Write the disks, and the views beside them.

    A map in a frame of its own has its positions and scales in that frame, under names of their
    own; those of the world, which have lost digits, are computed when it is read.
    """
    tensors: dict[str, Tensor] = {
        "keyframe_id": torch.from_numpy(views.keyframe_id),
        "keyframe_time": torch.from_numpy(views.timestamp),
        "keyframe_T_cw": torch.from_numpy(views.T_cw),
        "keyframe_has_mask": torch.from_numpy(views.has_mask),
    }
    names = _OWN if views.origin.any() or views.unit != 1.0 else {}
    for name in _SHAPES:
        tensors[names.get(name, name)] = getattr(views.disks, name).float()
    description = {
        "camera": asdict(views.camera),
        "render_camera": asdict(views.render_camera),
        "min_alpha": views.min_alpha,
        "max_spread": views.max_spread,
        "plane_reach": views.plane_reach,
        "origin": views.origin.tolist(),
        "unit": views.unit,
        "has_images": views.has_images,
    }
    _write(path, tensors, {**metadata, "views": description})


def load_map_views(
    path: str | Path, device: torch.device | str = "cpu"
) -> tuple[MapSnapshot, MapViews]:
    """Read the disks in the world, and the views beside them, which have them in the map's frame.

    Raises:
        InputError: the map cannot be read, or was written before maps had views.
    """
    file = load_map_file(path, device)
    if "views" not in file.metadata:
        raise InputError(
            f"{path} has no camera and no keyframes beside the disks, as an older geogs wrote it; "
            "run again to use the result further."
        )
    try:
        return file.disks, _views(file)
    except UNUSABLE as error:
        raise InputError(f"{path} does not say how the map was seen; was it changed?") from error


def _views(file: MapFile) -> MapViews:
    said = file.metadata["views"]
    tensors = file.tensors
    disks = file.disks
    position = tensors.get("map_position", disks.position).to(disks.position)
    scale = tensors.get("map_scale", disks.scale).to(disks.scale)
    if position.shape != disks.position.shape or scale.shape != disks.scale.shape:
        raise ValueError("its disks differ in number")
    of_keyframes = {name: tensors[f"keyframe_{name}"] for name in _OF_KEYFRAMES}
    if any(of_keyframes[name].dtype is not dtype for name, dtype in _OF_KEYFRAMES.items()):
        raise ValueError("its keyframes are of another type")
    ids, times, T_cw, masked = of_keyframes.values()
    if not times.shape == masked.shape == ids.shape or T_cw.shape != (*ids.shape, 4, 4):
        raise ValueError("its keyframes differ in number")
    origin, unit = _frame(said)
    spread = float(said["max_spread"])
    # Older files have no reach of their own: it was twice the spread.
    reach = float(said.get("plane_reach", 2 * spread))
    if not (holds((RIGID,), T_cw) and holds((), times) and holds((), reach)):
        raise ValueError("a pose is none, or a number is not finite")
    camera = camera_of(said["camera"])
    render_camera = camera_of(said["render_camera"])
    if render_camera.long_edge > 2 * camera.long_edge:
        raise ValueError("its depth maps are larger than its images")
    return MapViews(
        camera=camera,
        render_camera=render_camera,
        min_alpha=float(said["min_alpha"]),
        max_spread=spread,
        plane_reach=reach,
        origin=origin,
        unit=unit,
        disks=MapSnapshot(position, disks.quaternion, scale, disks.opacity),
        keyframe_id=ids.numpy(),
        timestamp=times.numpy(),
        T_cw=T_cw.numpy(),
        has_mask=masked.numpy(),
        has_images=bool(said["has_images"]),
    )
