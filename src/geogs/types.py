"""Frozen records that the modules exchange."""

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Float16, Float32, Float64, UInt8
from torch import Tensor

from geogs.config.setting import Range
from geogs.geometry.camera import Camera
from geogs.geometry.lie import matrix_to_quaternion, quaternion_multiply, quaternion_to_matrix
from geogs.limits import UNBOUNDED, AtLeast0, Pose, Positive
from geogs.short_repr import ShortRepr


@runtime_checkable
class MeasuredDepth(Protocol):
    """Depth of a sensor, read on demand."""

    def metres(self) -> Float32[np.ndarray, "h w"] | None:
        """Return depth z of every pixel, 0 where unknown; None where it cannot be read."""
        ...


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class MeasuredPose(ShortRepr):
    """Pose of the camera by another tracker."""

    T_cw: Pose
    """World to camera, metres, in the tracker's own world."""
    world: int = 0
    """Number of that world; poses of different worlds cannot be compared."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class SeenRows(ShortRepr):
    """Offsets and times of the pixels of a rolling-shutter image whose rows were rectified.

    The nodes lie in the middle of each eight pixels, and a step beyond the border; the image was
    resampled by bilinear interpolation between them.
    """

    offset: Float16[Tensor, "r c 2"]
    """Pixels from a node to where a pinhole with the camera's pose at that time sees the same."""
    seconds: Float16[Tensor, "r c"]
    """Time of exposure relative to the middle row."""
    doubt: float = 0.0
    """Relative standard error of the readout; 0 where it was given."""
    is_rectified: bool = True
    """If false, rows were not changed and ``seconds`` are those of a readout of one standard error:
    the shutter is assumed to be global, but may not be."""


@dataclass(frozen=True)
class FlowMatch:
    """Matches of the grid cells of one image in another."""

    pixels: Float32[Tensor, "e p 2"]
    """Position in the second image of each grid cell of the first."""
    weight: Annotated[Float32[Tensor, "e p 2"], Range(0)]
    """Inverse variance of x and y in 1 / pixel^2; zero where there is no match."""
    damping: Annotated[Float32[Tensor, "e p"], Range(0)] | None = None
    """Damping of the first image's inverse depth, in the units of its inverse variance; equal for
    all edges of a call that share the first image."""
    memory: tuple[Any, ...] | None = field(default=None, metadata={"stored": False})
    """State of the flow operator for each edge, passed to it when the edge is measured again."""

    def on_cpu(self) -> "FlowMatch":
        """Copy positions and weights to the CPU."""
        return FlowMatch(self.pixels.cpu(), self.weight.cpu())

    def sure(self) -> Bool[Tensor, "e p"]:
        """Return the confident cells: matched along both axes with at least a hundredth of the
        weight of the edge's best. Initial geometry is estimated from these, as there a guess would
        count as much as a good match."""
        weight = self.weight.amin(-1)
        best = torch.quantile(weight.float(), 0.98, dim=-1, keepdim=True)
        return (weight > 0) & (weight > 0.01 * best)

    def only_sure(self) -> "FlowMatch":
        """Return positions and weights, zero where a cell is not confident."""
        return FlowMatch(self.pixels, torch.where(self.sure()[..., None], self.weight, 0.0))


@dataclass(frozen=True, slots=True, repr=False)
class Frame(ShortRepr):
    """One image of the source at working resolution."""

    index: int
    """Position in the source after start, stop and stride; 0, 1, 2, ..."""
    timestamp: float
    """Seconds."""
    image: UInt8[np.ndarray, "h w 3"]
    """RGB."""
    follows_cut: bool = False
    """Whether it begins another video, so that no motion links it to the frame before."""
    depth: MeasuredDepth | None = None
    """Sensor depth of the image's pixels, if it is to be used."""
    pose: MeasuredPose | None = None
    """Pose prior by another tracker, if it is to be used."""
    rows: SeenRows | None = None
    """Rectification of its rows; None for a global shutter."""
    left: int | None = None
    """Number of images of its recording still to come; None where unknown."""
    mask: Bool[np.ndarray, "h w"] | None = None
    """Pixels that may show the scene; None where all do."""


@dataclass(frozen=True, slots=True)
class PoseCorrection:
    """Keyframe poses before and after a global correction, by keyframe id."""

    before: dict[int, Float[Tensor, "4 4"]]
    after: dict[int, Float[Tensor, "4 4"]]
    scale: dict[int, float]
    """Factor by which lengths around the keyframe were divided; 1 where only the pose changed."""
    of_all: bool = False
    """Whether all keyframes were adjusted; otherwise those before its first were not."""


@dataclass(frozen=True, slots=True)
class MetricScale:
    """Factor that converted the lengths of a map to metres."""

    origin: str
    """Source of the scale."""
    factor: Positive
    """Factor on all lengths."""
    deviation: AtLeast0
    """Relative standard deviation of the factor."""


@dataclass(frozen=True, slots=True)
class FoundLens:
    """Changes of an assumed camera that were estimated from all matches; none by default.

    They are to be made by :meth:`geogs.geometry.camera.Camera.moved`.
    """

    k1: float = 0.0
    k2: float = 0.0
    """Added to the radial terms."""
    deviation_k1: AtLeast0 = 0.0
    """Standard deviation."""
    deviation_k2: AtLeast0 = 0.0
    focal: Positive = 1.0
    """Focal length over the assumed one; 1 where it was not changed."""
    deviation_focal: AtLeast0 = 0.0
    right: float = 0.0
    down: float = 0.0
    """Offset of the principal point from the assumed one, in estimated focal lengths."""
    deviation_centre: AtLeast0 = 0.0
    varies_focal: AtLeast0 = 0.0
    varies_centre: AtLeast0 = 0.0
    """Root mean square variation from frame to frame of the focal length, relative, and of the
    principal point, in focal lengths; zero for a constant lens."""

    @property
    def varies(self) -> bool:
        """Whether intrinsics vary from frame to frame."""
        return self.varies_focal > 0 or self.varies_centre > 0

    @property
    def is_off_centre(self) -> bool:
        """Whether the principal point was corrected."""
        return self.right != 0 or self.down != 0

    def of_frame(self, own: "FrameLens") -> "FoundLens":
        """Return the lens of a frame with intrinsics of its own."""
        focal = self.focal * math.exp(own.focal)
        return replace(self, focal=focal, right=self.right + own.right, down=self.down + own.down)


@dataclass(frozen=True)
class FrameLens:
    """Intrinsics of one frame relative to the shared lens."""

    focal: float = 0.0
    """Logarithm of its focal length over the shared one."""
    right: float = 0.0
    down: float = 0.0
    """Offset of its principal point from the shared one, in focal lengths."""

    @property
    def sizes(self) -> tuple[float, float, float]:
        """All three values."""
        return self.focal, self.right, self.down


FrameState = Literal["tracked", "orientation only", "lost"]
"""Known part of a frame's pose: all of it, its orientation alone, or nothing."""


@dataclass(frozen=True, slots=True, repr=False)
class Trajectory:
    """Camera poses over time."""

    timestamps: Float[np.ndarray, "n"]
    """Seconds."""
    T_wc: Float[np.ndarray, "n 4 4"]
    """Camera to world, float64."""
    tracked: Bool[np.ndarray, "n"]
    """False where the position is not known, but interpolated or repeated."""
    oriented: Bool[np.ndarray, "n"] | None = None
    """True where only the orientation is known; None where there is no such frame."""

    def __repr__(self) -> str:
        return f"Trajectory({len(self.timestamps)} poses, {int(self.tracked.sum())} tracked)"

    @property
    def states(self) -> list[FrameState]:
        """State of each frame."""
        only = np.zeros_like(self.tracked) if self.oriented is None else self.oriented
        return [
            "tracked" if t else "orientation only" if o else "lost"
            for t, o in zip(self.tracked, only, strict=True)
        ]

    def rotated(self, R: Float64[np.ndarray, "3 3"]) -> "Trajectory":
        """Return the same path in a world that ``R`` maps this one to."""
        T = np.eye(4)
        T[:3, :3] = R
        return replace(self, T_wc=T @ self.T_wc)

    def of(self, state: FrameState) -> "Trajectory":
        """Return the frames of one state."""
        keep = np.array([known == state for known in self.states], bool)
        return Trajectory(self.timestamps[keep], self.T_wc[keep], self.tracked[keep])


@dataclass(frozen=True, slots=True, repr=False)
class FoundFrames(ShortRepr):
    """Frames of a video that were lost and relocalised afterwards, in time order."""

    numbers: tuple[int, ...]
    """Indices of the frames in the video, one for each row below."""
    timestamps: Float[np.ndarray, "n"]
    """Seconds."""
    T_cw: Float[np.ndarray, "n 4 4"]
    """World to camera, float64."""
    position: Float[np.ndarray, "n"]
    """Standard deviation of the camera's centre relative to the frames tracked before, map units;
    infinite where unknown."""
    rotation: Float[np.ndarray, "n"]
    """Standard deviation of the orientation, radians."""

    @staticmethod
    def none() -> "FoundFrames":
        """Return an empty set of frames."""
        return FoundFrames((), np.zeros(0), np.zeros((0, 4, 4)), np.zeros(0), np.zeros(0))

    def __len__(self) -> int:
        return len(self.numbers)

    def of(self, kept: Bool[np.ndarray, "n"]) -> "FoundFrames":
        """Return the frames where ``kept`` is true."""
        numbers = tuple(n for n, is_kept in zip(self.numbers, kept, strict=True) if is_kept)
        columns = (self.timestamps, self.T_cw, self.position, self.rotation)
        return FoundFrames(numbers, *(column[kept] for column in columns))


@dataclass(frozen=True, slots=True, repr=False)
class Uncertainty(ShortRepr):
    """Standard deviations of frames, earliest first; infinite where unknown."""

    timestamps: Float[np.ndarray, "n"]
    """Seconds."""
    position: Annotated[Float[np.ndarray, "n"], UNBOUNDED]
    """Camera centre, map units, all axes together: the expected error after alignment of the
    trajectory with the truth by a similarity."""
    rotation: Annotated[Float[np.ndarray, "n"], UNBOUNDED]
    """Orientation, radians."""
    depth: Annotated[Float[np.ndarray, "n"], UNBOUNDED]
    """Depth, relative, given a trajectory as long as the true one: of the best known 15 % of the
    frame's cells, as bare walls do not determine depth."""
    focal: AtLeast0 = 0.0
    """Focal length, relative: the width of things over their depth."""
    misfit: AtLeast0 = 0.0
    """Residuals of the tenth of the keyframes whose matches fit worst, over those of a typical
    keyframe; 0 where unknown."""
    focal_change: AtLeast0 = 0.0
    """Relative difference of the focal lengths that fit parts of the video best."""
    lens_change: AtLeast0 = 0.0
    """Fraction of the cost of the matches due to changes of the lens from frame to frame."""
    joined: Annotated[float, Range(0, 1)] = 1.0
    """Fraction of the keyframes in the largest rigidly connected part."""
    lens_varies: bool = False
    """Whether per-frame intrinsics were estimated, and the matches corrected for them."""

    def at(self, timestamps: Float[np.ndarray, "m"]) -> "Uncertainty":
        """Interpolate in time, constant beyond the ends; infinite without any frame."""
        known = (self.position, self.rotation, self.depth)
        if not len(self.timestamps):
            position, rotation, depth = (np.full(len(timestamps), np.inf) for _ in known)
        else:
            position, rotation, depth = (np.interp(timestamps, self.timestamps, c) for c in known)
        return replace(
            self, timestamps=timestamps, position=position, rotation=rotation, depth=depth
        )

    def with_found(self, found: FoundFrames) -> "Uncertainty":
        """Add relocalised frames; their own deviations are added to those of the frames around
        them, as independent ones."""
        around = self.at(found.timestamps)
        order = np.argsort(np.concatenate([self.timestamps, found.timestamps]), kind="stable")
        columns = (
            (self.timestamps, found.timestamps),
            (self.position, np.hypot(around.position, found.position)),
            (self.rotation, np.hypot(around.rotation, found.rotation)),
            (self.depth, around.depth),
        )
        times, position, rotation, depth = (np.concatenate(pair)[order] for pair in columns)
        return replace(self, timestamps=times, position=position, rotation=rotation, depth=depth)


@dataclass(frozen=True, slots=True, repr=False)
class MapSnapshot:
    """The disks of a map as plain numbers, detached from training."""

    position: Float[Tensor, "n 3"]
    quaternion: Float[Tensor, "n 4"]
    """w, x, y, z, unit norm."""
    scale: Float[Tensor, "n 2"]
    """Standard deviations along the two tangents, map units."""
    opacity: Float[Tensor, "n"]
    """Opacity in (0, 1)."""

    def __repr__(self) -> str:
        return f"MapSnapshot({len(self)} disks, {self.position.device})"

    def __len__(self) -> int:
        return len(self.position)

    @property
    def normal(self) -> Float[Tensor, "n 3"]:
        """Third axis of each disk, world frame."""
        return quaternion_to_matrix(self.quaternion)[..., 2]

    def in_world(self, origin: Float64[np.ndarray, "3"], unit: float) -> "MapSnapshot":
        """Transform the disks of a map with this ``origin`` and ``unit`` to the world."""
        position = self.position * unit + torch.from_numpy(origin).to(self.position)
        return MapSnapshot(position, self.quaternion, self.scale * unit, self.opacity)

    def scaled(self, factor: float) -> "MapSnapshot":
        """Return the disks with all lengths multiplied."""
        return replace(self, position=factor * self.position, scale=factor * self.scale)

    def rotated(self, R: Float64[np.ndarray, "3 3"]) -> "MapSnapshot":
        """Return the disks in a world that ``R`` maps this one to."""
        rotation = torch.from_numpy(R)
        position = self.position.double() @ rotation.mT.to(self.position.device)
        turn = matrix_to_quaternion(rotation).to(self.quaternion)
        quaternion = quaternion_multiply(turn.expand_as(self.quaternion), self.quaternion)
        return replace(self, position=position.to(self.position), quaternion=quaternion)

    def is_finite(self) -> bool:
        """Whether every number is finite."""
        parts = (self.position, self.quaternion, self.scale, self.opacity)
        return all(bool(torch.isfinite(p).all()) for p in parts)


@dataclass(frozen=True, slots=True, repr=False)
class RenderedKeyframe(ShortRepr):
    """The map rendered from a keyframe: input of the surface reconstruction."""

    keyframe_id: int
    camera: Camera
    """Camera of the maps."""
    T_cw: Float[Tensor, "4 4"]
    """World to camera, float64."""
    depth: Float[Tensor, "h w"]
    """Depth in map units; 0 where the map is too thin."""
    normal: Float[Tensor, "h w 3"]
    """Normal in the camera frame, facing the camera; zero where there is no depth."""
    weight: Float[Tensor, "h w"]
    """Confidence of the depth in [0, 1]; less where disks spread along the ray."""
    image: UInt8[np.ndarray, "h2 w2 3"] | None
    """RGB at working resolution; None in a result that was written without images."""
    timestamp: float
    """Seconds."""
    mask: Bool[Tensor, "h w"] | None = None
    """Pixels that belong to the scene; None where all do."""
