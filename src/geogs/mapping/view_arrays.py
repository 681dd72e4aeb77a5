"""Image-sized data of the keyframes of mapping: in memory while it is used, else in a file."""

from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8
from torch import Tensor

from geogs.config import LossConfig, MappingConfig
from geogs.depth.depth_view import DenseDepth
from geogs.geometry.camera import Camera
from geogs.geometry.jumps import DepthJumps, depth_jumps
from geogs.losses.multi_view import PhotoView
from geogs.losses.single_view import OUTSIDE, ViewConstants
from geogs.threads import worker_count
from geogs.world.arrays import ArrayTable
from geogs.world.keyframes import Keyframe, KeyframeTable
from geogs.world.lru import LruCache
from geogs.world.map import MapTable, SearchedDepth

DEPTHS_ON_GPU = 512
"""Most depths of unused views that stay on a GPU, as an upload takes longer than their use; at
320 x 180 pixels with normals they take 600 MB."""
READING_THREADS = 4
"""Most threads that read ahead; each mostly waits for a disk or a GPU."""
Basis = tuple[object, ...]
"""The replaceable objects that a view is loaded from."""


@dataclass(frozen=True)
class MapCameras:
    """One camera at the three sizes that mapping works with."""

    working: Camera
    """The size of the images as the tracker sees them."""
    render: Camera
    """The size of the rendered maps and keyframe depths."""
    photo: Camera
    """The size of the images that L_mv compares."""

    @staticmethod
    def of(camera: Camera, config: MappingConfig) -> "MapCameras":
        """The sizes of the settings, none above the working image."""
        working = max(camera.width, camera.height)
        long_edge = min(config.render_long_edge, working)
        photo = min(round(config.photo_scale * long_edge), working)
        return MapCameras(camera, camera.with_long_edge(long_edge), camera.with_long_edge(photo))


@dataclass(eq=False)
class LoadedView:
    """Image-sized data of a view; all but the depths follows from the keyframe's image."""

    image: UInt8[np.ndarray, "wh ww 3"]
    photo: PhotoView
    """Image with compensated exposure, on the map's device; its pose may be outdated."""
    normal: Float[Tensor, "h w 3"] | None
    """A prior's normals at the render size, on the map's device."""
    depth: DenseDepth | None = None
    scale: float = 1.0
    """Scale of the keyframe to which ``depth`` belongs."""
    constants: ViewConstants | None = None
    rendered_depth: Float[Tensor, "h w"] | None = None
    matched: tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "fh fw"]] | None = None
    """Grey images of the :class:`DepthView`, once they were needed."""
    is_depth_written: bool = True
    is_render_written: bool = True


CONFIDENT = 0.5
"""Least confidence of depths whose jumps count as edges."""


class ViewArrays:
    """Images, depths and constants of the views of a map; the last used are in memory.

    Depths follow the scale of their keyframes.
    """

    def __init__(
        self, table: MapTable, keyframes: KeyframeTable, cameras: MapCameras, loss: LossConfig
    ) -> None:
        self.table = table
        self.keyframes = keyframes
        self.cameras = cameras
        self.loss = loss
        self.device = table.disks.device
        self.loaded: LruCache[int, LoadedView] = LruCache(keyframes.arrays.resident, self._write)
        """The views in memory; ``load`` reads others."""
        self._ahead = ReadAhead(
            lambda id: self._with_constants(id, self._load(id)), self._basis, self.device
        )
        table.arrays.resident = keyframes.arrays.resident
        for id in table.resident:
            self.loaded.put(id, self._load(id, as_written=True))

    def put_mask(self, id: int, mask: Bool[np.ndarray, "h w"]) -> None:
        """Set the mask of a keyframe, of the size of its image."""
        size = (self.cameras.render.width, self.cameras.render.height)
        ratio = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        self.table.arrays.put("mask", id, ratio > 0.5)
        self.table.arrays.recent("mask there").drop(id)

    def read_ahead(self, ids: Iterable[int]) -> None:
        """Read some views in threads before they are used, and discard those of the last call that
        were not."""
        self._ahead.begin([i for i in ids if i not in self.loaded])

    def settle(self) -> None:
        """Write changes to the table, and the ids of the views in memory."""
        loaded = self.loaded.items()
        for id, view in loaded:
            self._write(id, view)
        self.table.resident = [id for id, _ in loaded]

    def forget_images(self) -> None:
        """Discard data made from the keyframes' images, which have been replaced."""
        self.settle()
        self._ahead.begin([])
        self.loaded = LruCache(self.loaded.limit, self._write)
        for id in self.table.views:
            self.table.arrays.recent("bare segments").drop(id)

    def load(self, id: int) -> LoadedView:
        """A view's data, read if it is not in memory."""
        loaded = self.loaded.get(id, lambda: self._ahead.take(id) or self._load(id))
        return self._at_scale(id, loaded)

    def mask(self, id: int) -> Bool[Tensor, "h w"] | None:
        """Pixels of the render size that belong to the scene; None for all."""
        arrays = self.table.arrays
        if not arrays.has("mask", id):
            return None
        return arrays.made(
            "mask there", id, lambda: torch.from_numpy(arrays.load("mask", id)).to(self.device)
        )

    def depth(self, id: int) -> DenseDepth:
        """The dense depth, which must exist."""
        loaded = self.loaded.peek(id)
        if loaded is None:
            return self._read_depth(id, self.keyframes[id].scale)
        depth = self._at_scale(id, loaded).depth
        assert depth is not None, f"keyframe {id} has no depth yet"
        return depth

    def set_depth(self, id: int, depth: DenseDepth) -> None:
        """Set the dense depth, and the losses' constants that depend on it."""
        keyframe = self.keyframes[id]
        mask = self.mask(id)
        render = self.cameras.render
        if (moving := keyframe.shown_moving) is not None:
            moving = keyframe.grid.enlarged(moving, render.width, render.height)
            depth = depth.unknown_in(moving)
        if mask is not None:
            depth = depth.within(mask)
        loaded = self.loaded.peek(id)
        if loaded is None:
            self._write_depth(id, depth, keyframe.scale)
            return
        loaded.depth = depth
        loaded.scale = keyframe.scale
        loaded.is_depth_written = False
        if loaded.constants is not None:
            prior, confidence, normal = self._prior(id, loaded, depth)
            loaded.constants = replace(
                loaded.constants,
                prior_depth=prior.float(),
                confidence=confidence.float(),
                prior_normal=normal,
            )

    def constants(self, id: int) -> ViewConstants:
        """Constants of the single-view losses; the keyframe must have a depth."""
        constants = self._with_constants(id, self.load(id)).constants
        assert constants is not None, f"keyframe {id} has no depth yet"
        return constants

    # --- from and to the file --------------------------------------------------------------

    def _load(self, id: int, as_written: bool = False) -> LoadedView:
        """Read a view; its depth at the keyframe's scale, or as it was written."""
        cameras = self.cameras
        loss = self.loss
        keyframe = self.keyframes[id]
        row = self.table.views[id]
        image = keyframe.straight_image
        photo = PhotoView.prepare(
            image, cameras.photo, keyframe.T_cw, loss.photo_blur, self.device, loss.colour
        )
        if row.exposure is not None:
            photo = photo.with_exposure(row.exposure)
        normal = None
        if loss.normal_weight:
            normal = _shrunk_normal(keyframe, cameras.render, self.device)
        loaded = LoadedView(image, photo, normal)
        if row.depth is not None:
            loaded.scale = row.depth.scale if as_written else keyframe.scale
            loaded.depth = self._read_depth(id, loaded.scale)
        rendered = self.table.arrays.get("rendered depth", id)
        if rendered is not None:
            loaded.rendered_depth = torch.from_numpy(rendered).to(self.device)
        return loaded

    def _with_constants(self, id: int, loaded: LoadedView) -> LoadedView:
        if loaded.constants is None and loaded.depth is not None:
            loaded.constants = ViewConstants.prepare(
                loaded.image, self.cameras.render, *self._prior(id, loaded, loaded.depth)
            )
        return loaded

    def _basis(self, id: int) -> Basis:
        """The objects that a view is loaded from; a change replaces them."""
        keyframe = self.keyframes[id]
        row = self.table.views[id]
        rendered = self.table.arrays.pieces.get("rendered depth", {}).get(id)
        return keyframe, keyframe.scale, row.exposure, row.depth, rendered

    def _write(self, id: int, loaded: LoadedView) -> None:
        if not loaded.is_depth_written and loaded.depth is not None:
            self._write_depth(id, loaded.depth, loaded.scale)
        if not loaded.is_render_written and loaded.rendered_depth is not None:
            self.table.arrays.put("rendered depth", id, loaded.rendered_depth.cpu().numpy())
        loaded.is_depth_written = loaded.is_render_written = True

    def _write_depth(self, id: int, depth: DenseDepth, scale: float) -> None:
        arrays = self.table.arrays
        row = self.table.views[id]
        row.depth = put_depth(arrays, id, depth, scale)
        if self.device.type == "cuda":
            arrays.recent("depth there", DEPTHS_ON_GPU).put(id, (row.depth, depth))

    def _read_depth(self, id: int, scale: float) -> DenseDepth:
        """Read the written depth at a scale of its keyframe."""
        arrays = self.table.arrays
        written = self.table.views[id].depth
        assert written is not None, f"keyframe {id} has no depth yet"
        if self.device.type == "cuda":
            recent = arrays.recent("depth there", DEPTHS_ON_GPU)
            known = recent.peek(id)
            if known is not None and known[0] is written:
                recent.put(id, known)
                depth = known[1]
                typical = torch.tensor(written.typical_at(scale))
                scaled = depth.depth * (scale / written.scale)
                return replace(depth, depth=scaled, median=typical, written=None)
        return get_depth(arrays, id, written, scale, self.device)

    def _at_scale(self, id: int, loaded: LoadedView) -> LoadedView:
        """The view, whose depth follows the keyframe's scale."""
        scale = self.keyframes[id].scale
        if loaded.depth is not None and loaded.scale != scale:
            self.set_depth(id, loaded.depth.scaled(scale / loaded.scale))
        return loaded

    def _prior(
        self, id: int, loaded: LoadedView, depth: DenseDepth
    ) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"], Float[Tensor, "h w 3"] | None]:
        """Depth, its weight in L_d, and normals: a prior's, else those that came with the depth."""
        is_measured = self.keyframes[id].measured is not None
        mask = self.mask(id)
        weight = depth.confidence * (self.loss.measured_factor if is_measured else 1.0)
        at_edges = confident_jumps(depth).around(self.loss.edge_reach)
        prior = depth.depth if mask is None else torch.where(mask, depth.depth, OUTSIDE)
        return (
            prior if depth.sky is None else torch.where(depth.sky, OUTSIDE, prior),
            torch.where(at_edges, self.loss.edge_factor * weight, weight),
            depth.normal if loaded.normal is None else loaded.normal,
        )


def put_depth(arrays: ArrayTable, id: int, depth: DenseDepth, scale: float) -> SearchedDepth:
    """Write the depth of a keyframe whose current scale is ``scale``.

    Raises:
        OutputError: the disk is full, or cannot be written.
    """
    maps = depth.arrays()
    arrays.put("depth", id, maps.depth)
    arrays.put("confidence", id, maps.confidence)
    # Half precision suffices: the normals are not measured with.
    normal = None if depth.normal is None else depth.normal.half()
    for name, values in (("depth normal", normal), ("sky", depth.sky)):
        if values is None:
            arrays.drop(name, id)
        else:
            arrays.put(name, id, values.cpu().numpy())
    return SearchedDepth(depth.typical, scale)


def get_depth(
    arrays: ArrayTable, id: int, stored: SearchedDepth, scale: float, device: torch.device
) -> DenseDepth:
    """Read the depth of a keyframe, converted to another scale of it."""
    depth, confidence = (torch.from_numpy(arrays.load(n, id)) for n in ("depth", "confidence"))
    if scale != stored.scale:
        depth = depth * (scale / stored.scale)
    normal = arrays.get("depth normal", id)
    sky = arrays.get("sky", id)
    return DenseDepth(
        depth.to(device),
        confidence.to(device),
        torch.tensor(stored.typical_at(scale)),
        normal=None if normal is None else torch.from_numpy(normal).float().to(device),
        sky=None if sky is None else torch.from_numpy(sky).to(device),
    )


def confident_jumps(depth: DenseDepth) -> DepthJumps:
    """Jumps between fairly certain depths."""
    return depth_jumps(torch.where(depth.confidence >= CONFIDENT, depth.depth, 0.0))


def _shrunk_normal(
    keyframe: Keyframe, render: Camera, device: torch.device | str
) -> Float[Tensor, "h w 3"] | None:
    """A keyframe's prior normals, averaged over the pixels of the render; zero where they differ.

    An average shorter than a half comes from an edge or from pixels that are not known.
    """
    normal = keyframe.prior_normal
    if normal is None:
        return None
    size = (render.width, render.height)
    full = normal.detach().cpu().float().numpy()
    mean = cv2.resize(full, size, interpolation=cv2.INTER_AREA)
    length = np.linalg.norm(mean, axis=-1, keepdims=True)
    unit = np.where(length > 0.5, mean / np.maximum(length, 1e-6), 0.0)
    return torch.from_numpy(unit.astype(np.float32)).to(device)


class ReadAhead:
    """Loads views by id in threads before they are used; ``take`` returns what loading now would.

    Views whose ``Basis`` has changed since are discarded.
    """

    def __init__(
        self, load: Callable[[int], LoadedView], basis: Callable[[int], Basis], device: torch.device
    ) -> None:
        """``load`` loads a view; several threads call it, on a GPU in the stream of ``begin``."""
        self._load = load
        self._basis = basis
        self._device = device
        self._readings: dict[int, tuple[Future[LoadedView], Basis]] = {}
        threads = min(READING_THREADS, worker_count())
        self._threads = ThreadPoolExecutor(threads, "views", torch.set_num_threads, (1,))

    def begin(self, ids: Iterable[int]) -> None:
        """Begin to load some views, and discard those of the last call that are not among them."""
        before = self._readings
        self._readings = {}
        stream = torch.cuda.current_stream() if self._device.type == "cuda" else None
        for id in ids:
            known = before.pop(id, None)
            if known is None:
                known = self._threads.submit(self._read, id, stream), self._basis(id)
            self._readings[id] = known
        for left, _ in before.values():
            left.cancel()

    def take(self, id: int) -> LoadedView | None:
        """A view that was or is being loaded; None if it was not, or its basis has changed."""
        reading = self._readings.pop(id, None)
        if reading is None:
            return None
        view, basis = reading
        if any(a is not b for a, b in zip(basis, self._basis(id), strict=True)):
            return None
        return view.result()

    def _read(self, id: int, stream: "torch.cuda.Stream | None") -> LoadedView:
        with torch.cuda.stream(stream):
            return self._load(id)
