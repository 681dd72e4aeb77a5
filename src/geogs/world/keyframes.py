"""All keyframes of a run, by stable id: images, poses and depths."""

import copy
import functools
from bisect import insort
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Float16, Float32, UInt8
from torch import Tensor

from geogs.camera.field_of_view import straight_camera
from geogs.camera.straight_view import FrameViews, StraightView
from geogs.config.setting import Range
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.geometry.lie import scaled, se3_inverse, sim3_scale
from geogs.limits import POSITIVE, UNBOUNDED, Id, KeyframeId, Number, Positive
from geogs.types import FoundLens, FrameLens, MeasuredPose, PoseCorrection
from geogs.world.arrays import NOT_STORED, RESIDENT, ArrayTable, PoseTable
from geogs.world.cell_depths import KeyframePrior, MeasuredCells
from geogs.world.grid import SampleGrid
from geogs.world.tables import check_arrays, check_tables

Encode = Callable[[UInt8[np.ndarray, "h w 3"]], Any]
"""A flow operator's encoding of an image."""

KEYFRAME_ARRAYS = {
    "image": UInt8[np.ndarray, "h w 3"],
    "prior normal": Float16[np.ndarray, "h w 3"],
    "sensor depth": Annotated[Float16[np.ndarray, "h w"], UNBOUNDED, Range(0)],
}
"""Large arrays of a keyframe, all optional."""

STRAIGHT = "straight image"
"""Name of the images in the pinhole of the map, which are computed from those as tracked."""
KNOWN = 0.3
"""Relative deviation up to which a depth is used to locate a camera."""
RELATIVE_FLOOR = 0.004
"""Relative depth deviation that remains however many matches there are."""


@dataclass(eq=False)
class Keyframe:
    """The one record of a keyframe's depth and scale; its pose and its images are in its table.

    A pose or a field is replaced, never changed in place: old references keep their old value.
    """

    id: Id
    """Stable and unique, increasing in time."""
    frame_index: Number
    timestamp: float
    """Seconds."""
    inverse_depth: Annotated[Float32[Tensor, "p"], POSITIVE]
    """Inverse depth on the grid of its table."""
    information: Annotated[Float32[Tensor, "p"], Range(0)]
    """Sum over matches of w |dp/dd|^2, plus that of a depth sensor; without a prior's."""
    prior: KeyframePrior | None = None
    scale: Positive = 1.0
    """Factor by which corrections have multiplied the lengths around it; lengths measured from it
    at another scale have to be multiplied by the ratio of the two."""
    moving: Bool[Tensor, "p"] | None = None
    """Cells that show something dynamic; None where none do, or before this was tested."""
    measured: MeasuredCells | None = None
    """Depth of a sensor; None without, or where the map is not metric."""
    pose: MeasuredPose | None = None
    """Pose by another tracker, in its own world, if any."""
    table: "KeyframeTable" = field(init=False, repr=False, metadata=NOT_STORED)
    """Table of this keyframe, set by the table."""
    own_encoded: Any = field(default=None, repr=False, metadata=NOT_STORED)
    """The encoded image, where the table cannot encode it again."""

    @property
    def grid(self) -> SampleGrid:
        """Sample grid of the depth."""
        return self.table.grid

    @property
    def T_cw(self) -> Float[Tensor, "4 4"]:
        """World to camera, float64, on the CPU whatever the device of the grid."""
        return self.table.poses[self.id]

    @T_cw.setter
    def T_cw(self, T_cw: Float[Tensor, "4 4"]) -> None:
        self.table.poses[self.id] = T_cw

    @property
    def image(self) -> UInt8[np.ndarray, "h w 3"]:
        """RGB at working resolution, as it was tracked; not to be changed in place."""
        image = self.table.arrays.get("image", self.id, recent=True)
        assert image is not None, f"keyframe {self.id} has no image"
        return image

    @property
    def straight_image(self) -> UInt8[np.ndarray, "h w 3"]:
        """The image in the pinhole of the map; not to be changed in place."""
        view = self.table.view_of(self.id)
        if view is None:
            return self.image
        straight: UInt8[np.ndarray, "h w 3"] = self.table.arrays.made(
            STRAIGHT, self.id, lambda: view.image(self.image)
        )
        return straight

    @property
    def encoded(self) -> Any:
        """The encoded image, computed again where it is no longer kept."""
        encode = self.table.encode
        if encode is None:
            return self.own_encoded
        return self.table.arrays.made("encoded", self.id, lambda: encode(self.image))

    @property
    def prior_normal(self) -> Float[Tensor, "h w 3"] | None:
        """Unit normals of a monocular prior for the straight image, in the camera frame and facing
        the camera; zero where unknown, None without a prior."""
        normal = self.table.arrays.get("prior normal", self.id)
        if normal is None:
            return None
        view = self.table.view_of(self.id)
        return torch.from_numpy(normal if view is None else view.nearest(normal))

    @prior_normal.setter
    def prior_normal(self, normal: Float[Tensor, "h w 3"]) -> None:
        self.table.arrays.put("prior normal", self.id, normal.half().cpu().numpy())

    @property
    def sensor_depth(self) -> Float32[np.ndarray, "h w"] | None:
        """Sensor depth in metres for the straight image, 0 where unknown; None without."""
        depth = self.table.arrays.get("sensor depth", self.id)
        if depth is None:
            return None
        view = self.table.view_of(self.id)
        metres = depth.astype(np.float32)
        return metres if view is None else view.depth(metres)

    @sensor_depth.setter
    def sensor_depth(self, metres: Float32[np.ndarray, "h w"]) -> None:
        # Half precision rounds by 0.05 %, a tenth of a sensor's error.
        self.table.arrays.put("sensor depth", self.id, metres.astype(np.float16))

    def copied_to(self, table: "KeyframeTable") -> "Keyframe":
        """Copy it for another table, without the pose."""
        twin = copy.copy(self)
        twin.prior = copy.copy(self.prior)
        twin.measured = copy.copy(self.measured)
        twin.table = table
        return twin

    def as_it_is(self) -> "Keyframe":
        """Copy it with its pose, into a table of its own."""
        twin = self.copied_to(self.table.mirror())
        twin.T_cw = self.T_cw
        return twin

    def rescale(self, factor: float) -> None:
        """Multiply every length that the camera sees by ``factor``; the pose stays."""
        if factor == 1.0:
            return
        self.inverse_depth = self.inverse_depth / factor
        self.information = self.information * factor**2
        self.scale = self.scale * factor
        if self.prior is not None:
            self.prior.rescale(factor)
        if self.measured is not None:
            self.measured.rescale(factor)

    def at_present_scale(self, T: Float[Tensor, "4 4"], scale: float) -> Float[Tensor, "4 4"]:
        """Convert a motion measured from here at an earlier ``scale`` to the present scale."""
        factor = self.scale / scale
        return T if factor == 1.0 else scaled(T, factor)

    @property
    def has_known_depth(self) -> Bool[Tensor, "p"]:
        """Cells whose relative depth deviation is below ``KNOWN``, if the poses are right."""
        return KNOWN**2 * self.inverse_depth.square() * self.information > 1

    @property
    def confident_information(self) -> Float[Tensor, "p"]:
        """Information of inverse depth for other stages, limited by the error no match removes.

        The relative deviation of depth is z / sqrt of this. A prior's information counts only where
        depth has been adjusted with it.
        """
        # Depths that agree with all matches still share an error of poses and scale.
        floor = (RELATIVE_FLOOR * self.inverse_depth).square()
        known = self.information
        if self.prior is not None:
            known = known + self.prior.information
        return known / (1 + known * floor)

    def depth_field(self) -> tuple[Float32[np.ndarray, "gh gw"], Float32[np.ndarray, "gh gw"]]:
        """Inverse depth and its ``confident_information`` as images of the cells of the straight
        image, on the CPU."""
        grid = self.grid
        shown = self._shown
        fields = torch.stack([self.inverse_depth, self.confident_information])
        if shown is not None:
            fields = grid.sample_field(fields.mT, shown).mT
        depth, information = fields.reshape(2, grid.height, grid.width).cpu().numpy()
        return depth, information

    @property
    def shown_moving(self) -> Bool[Tensor, "p"] | None:
        """Cells of the straight image that show something dynamic; None where unknown."""
        if self.moving is None or (shown := self._shown) is None:
            return self.moving
        nearest, is_cell = self.grid.cells_of(shown)
        return self.moving[nearest] & is_cell

    @property
    def _shown(self) -> Float[Tensor, "p 2"] | None:
        """Positions in the tracked image of the cells of the straight one; None where the two are
        the same."""
        view = self.table.view_of(self.id)
        return None if view is None else view.bent(self.grid.pixels)


@dataclass(eq=False)
class KeyframeTable:
    """All keyframes of a run by id, their poses as rows of one array, and their large arrays.

    Other code holds ids, or a :class:`KeyframeSet`, and looks keyframes up here.
    """

    next_id: Id = 0
    """Id of the next keyframe; ids grow and are never used twice."""
    keyframes: dict[Id, Keyframe] = field(default_factory=dict)
    poses: PoseTable = field(default_factory=PoseTable)
    arrays: ArrayTable = field(default_factory=ArrayTable)
    lens: FoundLens | None = None
    """What was found of the lens at the end, beyond the assumed camera; None where nothing was.
    Images, matches and depths of cells always belong to the images as tracked."""
    frame_lenses: dict[Id, FrameLens] = field(default_factory=dict)
    """Per-keyframe intrinsics relative to that lens, if any."""
    grid: SampleGrid = field(init=False, repr=False, metadata=NOT_STORED)
    """Grid of matches and depths, with the camera that saw them."""
    assumed: Camera = field(init=False, repr=False, metadata=NOT_STORED)
    """Camera of the images as it was assumed; the grid has it as it is estimated."""
    camera: Camera = field(init=False, repr=False, metadata=NOT_STORED)
    """Pinhole of the map and of straight images."""
    focal_deviation: float = field(default=0.0, init=False, repr=False, metadata=NOT_STORED)
    """Relative standard deviation of a focal length that was not given, before it is estimated from
    all matches."""
    encode: Encode | None = field(init=False, repr=False, metadata=NOT_STORED)
    """Encoder of the flow operator, for images that have to be encoded again."""
    set_of: dict[int, "KeyframeSet"] = field(init=False, repr=False, metadata=NOT_STORED)
    """Present set of each keyframe."""
    removed: list[int] = field(default_factory=list, init=False, repr=False, metadata=NOT_STORED)
    """Removed keyframes whose pose and arrays may still be in use."""

    @staticmethod
    def on(
        grid: SampleGrid, encode: Encode | None = None, resident: int = RESIDENT
    ) -> "KeyframeTable":
        """Return an empty table."""
        return KeyframeTable().attached(grid, encode, resident)

    def attached(
        self,
        grid: SampleGrid,
        encode: Encode | None = None,
        resident: int = RESIDENT,
        focal_deviation: float = 0.0,
        pinhole: Camera | None = None,
    ) -> "KeyframeTable":
        """Set what is not stored: the grid of depths, the image encoder, how many large arrays of
        a name stay in memory, the prior deviation of the focal length, and the pinhole of the map
        (default: :func:`~geogs.camera.field_of_view.straight_camera`). Return the table."""
        self.grid = grid
        self.assumed = grid.camera
        self.camera = pinhole or straight_camera(grid.camera)
        self.encode = encode
        self.set_of = {}
        if self.lens is not None:
            self.see_by(_view(self.camera, self.assumed, self.lens).seen_by)
        self.focal_deviation = focal_deviation
        self.arrays.resident = resident
        for keyframe in self.keyframes.values():
            keyframe.table = self
        return self

    def see_by(self, camera: Camera) -> None:
        """Assume another camera for matches and depths."""
        self.grid = SampleGrid(camera, self.grid.device)

    def view_of(self, id: int) -> StraightView | None:
        """Return how the image of a keyframe is straightened; None where it is straight."""
        view = self.view
        return None if view is None else FrameViews(view, self.frame_lenses).of(id)

    @property
    def view(self) -> StraightView | None:
        """How images are straightened by the shared lens; None where they are straight."""
        if self.lens is None and self.assumed == self.camera:
            return None
        return _view(self.camera, self.assumed, self.lens or FoundLens())

    def reader(self, id: int) -> Callable[[], UInt8[np.ndarray, "h w 3"]]:
        """Return what reads the straight image of a keyframe, as it is now, from the file."""
        stored = self.arrays.pieces["image"][id]
        view = self.view_of(id)
        return stored.load if view is None else lambda: view.image(stored.load())

    def straighten(self, lens: FoundLens, own: Mapping[int, FrameLens]) -> None:
        """Straighten images by what was found of the lens, and of that of each keyframe, by id."""
        self.lens = lens
        self.frame_lenses = dict(own)
        self.arrays.recent(STRAIGHT).clear()

    def mirror(self) -> "KeyframeTable":
        """Return an empty table that shares the large arrays of this one."""
        twin = KeyframeTable(arrays=self.arrays, lens=self.lens, frame_lenses=self.frame_lenses)
        twin.grid = self.grid
        twin.assumed = self.assumed
        twin.camera = self.camera
        twin.encode = self.encode
        twin.set_of = {}
        return twin

    def __getitem__(self, id: int) -> Keyframe:
        return self.keyframes[id]

    def __contains__(self, id: object) -> bool:
        return id in self.set_of

    def forget_removed(self) -> None:
        """Free poses and large arrays of removed keyframes."""
        for id in self.removed:
            self.arrays.forget(id)
            self.poses.T_cw.pop(id, None)
        self.removed = []

    def new_set(self) -> "KeyframeSet":
        """Return an empty set."""
        return KeyframeSet().attached(self)


@dataclass(eq=False)
class KeyframeSet:
    """Keyframes of a table whose poses share a gauge (world and unit); in order of time."""

    members: list[KeyframeId] = field(default_factory=list)
    """Ids of the keyframes, earliest first."""
    table: KeyframeTable = field(init=False, repr=False, metadata=NOT_STORED)
    _corrections: list[PoseCorrection] = field(
        default_factory=list, init=False, repr=False, metadata=NOT_STORED
    )
    """Not yet taken; a checkpoint is written when all have been."""

    def attached(self, table: KeyframeTable) -> "KeyframeSet":
        """Attach the set to the table of its keyframes and return it."""
        self.table = table
        table.set_of.update(dict.fromkeys(self.members, self))
        return self

    def __len__(self) -> int:
        return len(self.members)

    def __iter__(self) -> Iterator[Keyframe]:
        return (self.table.keyframes[id] for id in self.members)

    def __getitem__(self, id: int) -> Keyframe:
        if id not in self:
            raise KeyError(id)
        return self.table.keyframes[id]

    def __contains__(self, id: object) -> bool:
        return id in self.table.set_of and self.table.set_of[cast(int, id)] is self

    @property
    def grid(self) -> SampleGrid:
        """Sample grid of the depths."""
        return self.table.grid

    @property
    def camera(self) -> Camera:
        """Pinhole of the map."""
        return self.table.camera

    @property
    def ids(self) -> list[int]:
        """All ids, earliest first."""
        return list(self.members)

    def add(
        self,
        frame_index: int,
        timestamp: float,
        image: UInt8[np.ndarray, "h w 3"],
        encoded: Any,
        T_cw: Float[Tensor, "4 4"],
        id: int | None = None,
    ) -> Keyframe:
        """Add a keyframe with unit inverse depth and no information: the latest, or with ``id`` one
        that was removed."""
        table = self.table
        grid = self.table.grid
        table.forget_removed()
        if id is None:
            id = table.next_id
            table.next_id = table.next_id + 1
        ones = torch.ones(grid.size, device=grid.device)
        keyframe = Keyframe(id, frame_index, timestamp, ones, 0 * ones)
        table.arrays.put("image", id, image, recent=True)
        if table.encode is None:
            keyframe.own_encoded = encoded
        else:
            table.arrays.recent("encoded").put(id, encoded)
        table.poses[id] = T_cw
        self.put(keyframe)
        return keyframe

    def put(self, keyframe: Keyframe) -> None:
        """Add an existing keyframe under its own id; its pose is in the table."""
        keyframe.table = self.table
        self.table.keyframes[keyframe.id] = keyframe
        self.table.set_of[keyframe.id] = self
        insort(self.members, keyframe.id)

    def absorb(self, other: "KeyframeSet") -> None:
        """Take over the keyframes of another set, already in this set's gauge."""
        self.members = sorted([*self.members, *other.members])
        self.table.set_of.update(dict.fromkeys(other.members, self))
        other.members = []

    def remove(self, id: int) -> Keyframe:
        """Remove a keyframe from set and table; pose and images last until the next is added."""
        table = self.table
        self.members.remove(id)
        del table.set_of[id]
        table.removed.append(id)
        return table.keyframes.pop(id)

    def poses(self, ids: Sequence[int]) -> Float[Tensor, "n 4 4"]:
        """Return poses, world to camera, float64, on the CPU."""
        return torch.from_numpy(self.table.poses.rows(ids))

    def relative_poses(self, pairs: Sequence[tuple[int, int]]) -> Float[Tensor, "e 4 4"]:
        """Return T_ji of each pair (i, j): from the camera of the first to that of the second."""
        source, target = (self.poses([pair[k] for pair in pairs]) for k in (0, 1))
        return target @ se3_inverse(source)

    def inverse_depths(self, ids: Sequence[int]) -> Float[Tensor, "n p"]:
        """Return inverse depths on the grid."""
        return torch.stack([self[i].inverse_depth for i in ids])

    def informations(self, ids: Sequence[int]) -> Float[Tensor, "n p"]:
        """Return the information on the grid, pixels^2 per inverse depth^2."""
        return torch.stack([self[i].information for i in ids])

    def moving(self, ids: Sequence[int]) -> Bool[Tensor, "n p"]:
        """Return which cells show something dynamic."""
        none = torch.zeros(self.grid.size, dtype=torch.bool, device=self.grid.device)
        found = (self[i].moving for i in ids)
        return torch.stack([none if cells is None else cells for cells in found])

    def median_depths(self, ids: Sequence[int]) -> Float[Tensor, "n"]:
        """Return the median depth of each keyframe's cells, float64, on the CPU."""
        return 1 / self.inverse_depths(ids).median(1).values.cpu().double()

    def rescale(self, factor: float) -> None:
        """Multiply every length by ``factor``."""
        for keyframe in self:
            keyframe.T_cw = scaled(keyframe.T_cw, factor)
            keyframe.rescale(factor)

    def correct(self, correction: PoseCorrection) -> None:
        """Apply poses and scales of a loop closure or another global correction.

        Stages that keep data in world coordinates read it by ``take_corrections``.
        """
        for id, T in correction.after.items():
            keyframe = self[id]
            keyframe.T_cw = T.to(keyframe.T_cw)
            keyframe.rescale(1 / correction.scale.get(id, 1.0))
        self._corrections.append(correction)

    def take_corrections(self) -> list[PoseCorrection]:
        """Return the corrections made since the last call, earliest first."""
        taken = self._corrections
        self._corrections = []
        return taken

    def moved(self, S: Float[Tensor, "4 4"]) -> PoseCorrection:
        """Return the correction to another world, given the Sim(3) from it to the present one."""
        scale = float(sim3_scale(S))
        before = {k.id: k.T_cw for k in self}
        after = {}
        for k, T in before.items():
            after[k] = T @ S.to(T)
            after[k][:3] /= scale
        return PoseCorrection(before, after, dict.fromkeys(before, scale))


@functools.lru_cache(maxsize=1)
def _view(camera: Camera, assumed: Camera, lens: FoundLens) -> StraightView:
    """Return one cached view for all keyframes."""
    return StraightView(camera, assumed, lens)


def check_keyframes(table: KeyframeTable, sets: Iterable[KeyframeSet]) -> None:
    """Check sets that were read against their table, and the table against its grid's camera.

    Raises InputError if a keyframe is missing, of another camera, or out of order.
    """
    sizes = table.grid.sizes
    seen = set[int]()
    check_tables(KeyframeTable, table, sizes, {})
    check_arrays(table.arrays, KEYFRAME_ARRAYS, sizes, range(table.next_id))
    for members in (keyframes.members for keyframes in sets):
        last = -1
        for id in members:
            is_whole = table.arrays.has("image", id) and id in table.poses.T_cw
            if id not in table.keyframes or not is_whole:
                raise InputError(f"keyframe {id} is missing")
            if table.keyframes[id].id != id or id in seen or not last < id < table.next_id:
                raise InputError(f"keyframe {id} is not in its place")
            seen.add(id)
            last = id
