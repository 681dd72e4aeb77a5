"""The large parts of the mapper's views: in memory while they are used, else in a file."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from geogs.config import LossConfig
from geogs.depth.view import DenseDepth, depth_images
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.losses.multi_view import PhotoView
from geogs.losses.single_view import OUTSIDE, ViewConstants
from geogs.mapping.cameras import MapCameras
from geogs.mapping.held_depths import HeldDepths
from geogs.mapping.read_ahead import ReadAhead
from geogs.mapping.stored_maps import StoredDepth, StoredMaps, ViewMaps
from geogs.world.archive import Archive, Archived
from geogs.world.keyframes import Keyframe, KeyframeTable
from geogs.world.lru import LruCache


@dataclass(frozen=True, eq=False)
class MapsState:
    """What a checkpoint holds of the maps of a view."""

    depth: StoredDepth | None
    rendered_depth: Archived | None
    light: Float[Tensor, "2"] | None


@dataclass(frozen=True, eq=False)
class PoolState:
    """What a checkpoint holds of a pool."""

    archive: Archive
    maps: dict[int, MapsState]
    """By keyframe."""
    resident: list[int]
    """Keyframes whose maps are in memory, those used last at the end."""


class ViewPool:
    """Images, depths and constants of all views, of which those used last are in memory.

    Depths follow the scale of their keyframes.
    """

    def __init__(
        self, cameras: MapCameras, loss: LossConfig, device: torch.device, resident: int
    ) -> None:
        self.cameras = cameras
        self.loss = loss
        self.device = device
        self.archive = Archive()
        self._stored: dict[int, StoredMaps] = {}
        self._maps: LruCache[int, ViewMaps] = LruCache(resident, self._store)
        self._held = HeldDepths(device)
        self._ahead = ReadAhead(self._load_with_constants)

    def add(self, keyframe: Keyframe, mask: Bool[np.ndarray, "h w"] | None = None) -> None:
        """Take up a keyframe; it has no depth outside a mask of the size of its image."""
        inside = None
        if mask is not None:
            render = self.cameras.render
            size = (render.width, render.height)
            share = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
            inside = torch.from_numpy(share > 0.5).to(self.device)
        self._stored[keyframe.id] = StoredMaps(keyframe, inside)
        self.maps(keyframe.id)

    def move_to(self, keyframes: KeyframeTable) -> None:
        """Go on with the keyframes of another store, which are what its own are."""
        for id, stored in self._stored.items():
            stored.keyframe = keyframes[id]

    def mask(self, id: int) -> Bool[Tensor, "h w"] | None:
        """Pixels of the render size that belong to the scene; none takes all."""
        return self._stored[id].mask

    def is_resident(self, id: int) -> bool:
        """Whether its images are in memory."""
        return id in self._maps

    def maps(self, id: int) -> ViewMaps:
        """Everything in memory, brought back if need be."""
        stored = self._stored[id]
        maps = self._maps.get(id, lambda: self._ahead.take(stored) or self._load(stored))
        return self._at_scale(maps, stored)

    def read_ahead(self, ids: Iterable[int]) -> None:
        """Let threads bring some views back that will soon be asked for, and forget the views of
        the last such call that were not."""
        self._ahead.begin([self._stored[i] for i in ids if i not in self._maps])

    def depth_images(
        self, id: int
    ) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "fh fw"]]:
        """The grey images that depths are matched by, see :func:`geogs.depth.view.depth_images`."""
        maps = self.maps(id)
        if maps.matched is None:
            maps.matched = depth_images(maps.image, self.cameras.render)
        return maps.matched

    def has_depth(self, id: int) -> bool:
        """Whether its depth has been estimated."""
        maps = self._maps.peek(id)
        return (self._stored[id].depth if maps is None else maps.depth) is not None

    def depth(self, id: int) -> DenseDepth | None:
        """The dense depth, once estimated; what is not in memory stays where it is."""
        maps, stored = self._maps.peek(id), self._stored[id]
        if maps is not None:
            return self._at_scale(maps, stored).depth
        if stored.depth is None:
            return None
        return self._load_depth(stored, stored.depth, stored.keyframe.scale)

    def typical_depth(self, id: int) -> float:
        """Median of the dense depth, map units."""
        stored = self._stored[id]
        if id not in self._maps and stored.depth is not None:
            return stored.depth.typical_at(stored.keyframe.scale)
        depth = self.depth(id)
        assert depth is not None, f"keyframe {id} has no depth yet"
        return depth.typical

    def set_depth(self, id: int, depth: DenseDepth) -> None:
        """Take over a dense depth, on which the losses' constants then live."""
        stored, maps = self._stored[id], self._maps.peek(id)
        if stored.keyframe.moving is not None:
            render = self.cameras.render
            grid = stored.keyframe.grid
            moving = grid.enlarged(stored.keyframe.moving, render.width, render.height)
            depth = depth.unsure_where(moving)
        if stored.mask is not None:
            depth = depth.within(stored.mask)
        if maps is None:
            stored.depth = StoredDepth.of(depth, stored.keyframe.scale, self.archive)
            self._held.put(id, stored.depth, depth)
            return
        maps.depth, maps.scale, maps.is_depth_stored = depth, stored.keyframe.scale, False
        if maps.constants is not None:
            maps.constants = replace(
                maps.constants,
                prior_depth=self._prior_depth(stored, depth).float(),
                confidence=self._weight(stored, depth).float(),
                prior_normal=self._prior_normal(maps, depth),
            )

    def constants(self, id: int) -> ViewConstants | None:
        """What the single-view losses need; None until the keyframe has a depth."""
        maps = self.maps(id)
        if maps.constants is None and maps.depth is not None:
            maps.constants = self._constants(maps, maps.depth, self._stored[id])
        return maps.constants

    def light(self, id: int) -> Float[Tensor, "2"] | None:
        """Gain and offset of a view's grey values, once known."""
        return self._stored[id].light

    def set_light(self, id: int, light: Float[Tensor, "2"]) -> None:
        """Bring a view, whose light was not known, into the light of all."""
        self._stored[id].light = light
        maps = self._maps.peek(id)
        if maps is not None:
            maps.photo = light[0] * maps.photo + light[1]

    def set_rendered_depth(self, id: int, depth: Float[Tensor, "h w"] | None) -> None:
        """Take over the map's last rendering from a view, or that there is none any more."""
        if depth is None:
            self._stored[id].rendered_depth = None
        if id in self._maps or depth is not None:
            maps = self.maps(id)
            maps.rendered_depth, maps.is_render_stored = depth, False

    def state(self) -> PoolState:
        """What a checkpoint holds; what has changed is archived, and stays in memory."""
        held = self._maps.items()
        for id, maps in held:
            self._store(id, maps)
        stored = {
            id: MapsState(s.depth, s.rendered_depth, s.light) for id, s in self._stored.items()
        }
        return PoolState(self.archive, stored, [id for id, _ in held])

    def load(self, state: PoolState, keyframes: Mapping[int, Keyframe]) -> None:
        """Give the views of some keyframes, added or not, the maps of another pool.

        Raises:
            InputError: they are of another size.
        """
        self.archive = state.archive
        size = self.cameras.render.height, self.cameras.render.width
        for id, saved in state.maps.items():
            parts = [saved.rendered_depth]
            if saved.depth is not None:
                parts += [saved.depth.depth, saved.depth.confidence]
            if any(part is not None and part.shape != size for part in parts):
                raise InputError(f"the depth of keyframe {id} has another size")
            mask = self._stored[id].mask if id in self._stored else None
            self._maps.drop(id)
            light = None if saved.light is None else saved.light.to(self.device)
            self._stored[id] = StoredMaps(
                keyframes[id], mask, saved.depth, saved.rendered_depth, light
            )
        for id in state.resident:
            self._maps.put(id, self._load(self._stored[id], as_archived=True))

    def _store(self, id: int, maps: ViewMaps) -> None:
        stored = self._stored[id]
        if not maps.is_depth_stored and maps.depth is not None:
            stored.depth = StoredDepth.of(maps.depth, maps.scale, self.archive)
            self._held.put(id, stored.depth, maps.depth)
        if not maps.is_render_stored and maps.rendered_depth is not None:
            stored.rendered_depth = self.archive.put(maps.rendered_depth.cpu().numpy())
        maps.is_depth_stored = maps.is_render_stored = True

    def _load(self, stored: StoredMaps, as_archived: bool = False) -> ViewMaps:
        """The maps of a view; its depth at the keyframe's scale, or as it was archived."""
        cameras, loss, keyframe = self.cameras, self.loss, stored.keyframe
        image = keyframe.image
        photo = PhotoView.prepare(
            image, cameras.photo, keyframe.T_cw, loss.photo_blur, self.device, loss.colour
        ).planes
        if stored.light is not None:
            photo = stored.light[0] * photo + stored.light[1]
        normal = None
        if loss.normal_weight:
            normal = _shrunk_normal(keyframe, cameras.render, self.device)
        maps = ViewMaps(image, photo, normal)
        if stored.depth is not None:
            maps.scale = stored.depth.scale if as_archived else keyframe.scale
            maps.depth = self._load_depth(stored, stored.depth, maps.scale)
        if stored.rendered_depth is not None:
            rendered = torch.from_numpy(stored.rendered_depth.load())
            maps.rendered_depth = rendered.to(self.device)
        return maps

    def _load_depth(self, stored: StoredMaps, depth: StoredDepth, scale: float) -> DenseDepth:
        held = self._held.get(stored.keyframe.id, depth, scale)
        return depth.load(scale, self.device) if held is None else held

    def _load_with_constants(self, stored: StoredMaps) -> ViewMaps:
        """The maps of a view that is about to be trained."""
        maps = self._load(stored)
        if maps.depth is not None:
            maps.constants = self._constants(maps, maps.depth, stored)
        return maps

    def _constants(self, maps: ViewMaps, depth: DenseDepth, stored: StoredMaps) -> ViewConstants:
        return ViewConstants.prepare(
            maps.image, self.cameras.render, self._prior_depth(stored, depth),
            self._weight(stored, depth), self._prior_normal(maps, depth),
        )  # fmt: skip

    def _weight(self, stored: StoredMaps, depth: DenseDepth) -> Float[Tensor, "h w"]:
        """Of each pixel in L_d."""
        is_measured = stored.keyframe.measured is not None
        return depth.confidence * (self.loss.measured_factor if is_measured else 1.0)

    def _at_scale(self, maps: ViewMaps, stored: StoredMaps) -> ViewMaps:
        """The maps, whose depth follows the keyframe's scale."""
        if maps.depth is not None and maps.scale != stored.keyframe.scale:
            depth = maps.depth.scaled(stored.keyframe.scale / maps.scale)
            self.set_depth(stored.keyframe.id, depth)
        return maps

    @staticmethod
    def _prior_normal(maps: ViewMaps, depth: DenseDepth) -> Float[Tensor, "h w 3"] | None:
        """A prior's normals, else those that came with the depth."""
        return depth.normal if maps.normal is None else maps.normal

    @staticmethod
    def _prior_depth(stored: StoredMaps, depth: DenseDepth) -> Float[Tensor, "h w"]:
        if stored.mask is None:
            return depth.depth
        return torch.where(stored.mask, depth.depth, OUTSIDE)


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
