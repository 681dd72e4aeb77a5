"""Frozen records that the parts exchange."""

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Float16, Float32, Float64, UInt8
from torch import Tensor

from geogs.config.setting import Range
from geogs.geometry.camera import Camera
from geogs.geometry.lie import quaternion_to_matrix
from geogs.limits import UNBOUNDED, AtLeast0, Pose, Positive
from geogs.short_repr import ShortRepr


@runtime_checkable
class MeasuredDepth(Protocol):
    """Depth of a sensor, read when it is asked for."""

    def metres(self) -> Float32[np.ndarray, "h w"] | None:
        """Depth z of every pixel, 0 where unknown; None where it cannot be read."""
        ...


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class MeasuredPose(ShortRepr):
    """Pose of the camera by another tracker."""

    T_cw: Pose
    """World to camera, metres, in a world of its own."""
    world: int = 0
    """Poses of different worlds cannot be compared."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class SeenRows(ShortRepr):
    """Where and when a rolling shutter saw the pixels of an image whose rows were rectified.

    The nodes lie in the middle of each eight pixels, and a step beyond the border; the image was
    resampled by bilinear interpolation between them.
    """

    offset: Float16[Tensor, "r c 2"]
    """Pixels from a node to where a pinhole with the camera's pose of that time saw the same."""
    seconds: Float16[Tensor, "r c"]
    """Time of exposure from that of the middle row."""
    doubt: float = 0.0
    """Relative standard error of the readout; 0 where it was given."""
    is_rectified: bool = True
    """Otherwise rows are as they came, and ``seconds`` those of a readout of one standard error:
    the shutter is assumed to be global, and may not be."""


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
    """State of the flow operator for each edge, which it is given when it measures that again."""

    def on_cpu(self) -> "FlowMatch":
        """Positions and weights alone, on the CPU."""
        return FlowMatch(self.pixels.cpu(), self.weight.cpu())

    def sure(self) -> Bool[Tensor, "e p"]:
        """Confident cells: matched along both axes with at least a hundredth of the weight of the
        edge's best. A first geometry is estimated from these, where a guess would count like a
        good match."""
        weight = self.weight.amin(-1)
        best = torch.quantile(weight.float(), 0.98, dim=-1, keepdim=True)
        return (weight > 0) & (weight > 0.01 * best)

    def only_sure(self) -> "FlowMatch":
        """Positions and weights, which are zero where a cell is not confident."""
        return FlowMatch(self.pixels, torch.where(self.sure()[..., None], self.weight, 0.0))


@dataclass(frozen=True, slots=True, repr=False)
class Frame(ShortRepr):
    """One undistorted image of the source at working resolution."""

    index: int
    """Position in the source after start, stop and stride; 0, 1, 2, ..."""
    timestamp: float
    """Seconds."""
    image: UInt8[np.ndarray, "h w 3"]
    """RGB."""
    follows_cut: bool = False
    """Whether it begins another video, so that no motion links it to the frame before."""
    depth: MeasuredDepth | None = None
    """Depth of the image's pixels, where a sensor measured it and it is to be used."""
    pose: MeasuredPose | None = None
    """Prior by another tracker, where there is one and it is to be used."""
    rows: SeenRows | None = None
    """Rectification of its rows; none for a global shutter."""
    left: int | None = None
    """Images of its recording that are still to come; none where that is not known."""
    mask: Bool[np.ndarray, "h w"] | None = None
    """Pixels that may show the scene; none where all do."""


@dataclass(frozen=True, slots=True)
class PoseCorrection:
    """Keyframe poses before and after a global correction, by keyframe id."""

    before: dict[int, Float[Tensor, "4 4"]]
    after: dict[int, Float[Tensor, "4 4"]]
    scale: dict[int, float]
    """Factor by which lengths around the keyframe were divided; 1 where only the pose moved."""
    of_all: bool = False
    """Whether all keyframes were adjusted together; otherwise those before its first were not."""


@dataclass(frozen=True, slots=True)
class MetricScale:
    """Factor by which the lengths of a map became metres."""

    origin: str
    """Where it comes from."""
    factor: Positive
    """All lengths were multiplied by it."""
    deviation: AtLeast0
    """Relative standard deviation of the factor."""


@dataclass(frozen=True, slots=True)
class FoundLens:
    """Distortion (OpenCV's k1 and k2) and focal length estimated from all matches, for images that
    were assumed to be those of a pinhole.

    A ray x, y was seen at focal (1 + k1 r^2 + k2 r^4) times that, about a principal point.
    """

    k1: float
    k2: float
    deviation_k1: AtLeast0
    """Standard deviation."""
    deviation_k2: AtLeast0
    focal: Positive = 1.0
    """Focal length over the assumed one; 1 where it was not estimated, or is right."""
    deviation_focal: AtLeast0 = 0.0
    right: float = 0.0
    down: float = 0.0
    """Offset of the principal point from the assumed one, in the focal lengths found."""
    deviation_centre: AtLeast0 = 0.0
    varies_focal: AtLeast0 = 0.0
    varies_centre: AtLeast0 = 0.0
    """Variation from frame to frame of the focal length, relative, and of the principal point, in
    focal lengths; root mean square, zero where all frames are alike."""

    @property
    def varies(self) -> bool:
        """Whether frames have lenses of their own."""
        return self.varies_focal > 0 or self.varies_centre > 0

    @property
    def is_off_centre(self) -> bool:
        """Whether the principal point was corrected."""
        return self.right != 0 or self.down != 0

    def of_frame(self, own: "FrameLens") -> "FoundLens":
        """The lens of a frame with a deviation of its own."""
        focal = self.focal * math.exp(own.focal)
        return replace(self, focal=focal, right=self.right + own.right, down=self.down + own.down)


@dataclass(frozen=True)
class FrameLens:
    """Deviation of the lens of one frame from that of all."""

    focal: float = 0.0
    """Logarithm of its focal length over that of all."""
    right: float = 0.0
    down: float = 0.0
    """Offset of its principal point from theirs, in focal lengths."""

    @property
    def sizes(self) -> tuple[float, float, float]:
        """All three."""
        return self.focal, self.right, self.down


FrameState = Literal["tracked", "orientation only", "lost"]
"""What is known of a frame: its pose, its orientation alone, or nothing."""


@dataclass(frozen=True, slots=True, repr=False)
class Trajectory(ShortRepr):
    """Camera poses over time."""

    timestamps: Float[np.ndarray, "n"]
    """Seconds."""
    T_wc: Float[np.ndarray, "n 4 4"]
    """Camera to world, float64."""
    tracked: Bool[np.ndarray, "n"]
    """False where the position is not known, but interpolated or held."""
    oriented: Bool[np.ndarray, "n"] | None = None
    """True where no more than the orientation is known; none where there is no such frame."""

    @property
    def states(self) -> list[FrameState]:
        """What is known of each frame."""
        only = np.zeros_like(self.tracked) if self.oriented is None else self.oriented
        return [
            "tracked" if t else "orientation only" if o else "lost"
            for t, o in zip(self.tracked, only, strict=True)
        ]

    def of(self, state: FrameState) -> "Trajectory":
        """The frames of one state."""
        keep = np.array([known == state for known in self.states], bool)
        return Trajectory(self.timestamps[keep], self.T_wc[keep], self.tracked[keep])


@dataclass(frozen=True, slots=True, repr=False)
class FoundFrames(ShortRepr):
    """Frames of a video that had no pose and were given one afterwards, in time order."""

    numbers: tuple[int, ...]
    """Indices of the frames in the video, one for each row of what follows."""
    timestamps: Float[np.ndarray, "n"]
    """Seconds."""
    T_cw: Float[np.ndarray, "n 4 4"]
    """World to camera, float64."""
    position: Float[np.ndarray, "n"]
    """Standard deviation of the camera's centre relative to the frames that had a pose before, map
    units; infinite where it is not known."""
    rotation: Float[np.ndarray, "n"]
    """Standard deviation of the orientation, radians."""

    @staticmethod
    def none() -> "FoundFrames":
        """No frames."""
        return FoundFrames((), np.zeros(0), np.zeros((0, 4, 4)), np.zeros(0), np.zeros(0))

    def __len__(self) -> int:
        return len(self.numbers)

    def of(self, kept: Bool[np.ndarray, "n"]) -> "FoundFrames":
        """Those of the frames that are kept."""
        numbers = tuple(n for n, is_kept in zip(self.numbers, kept, strict=True) if is_kept)
        columns = (self.timestamps, self.T_cw, self.position, self.rotation)
        return FoundFrames(numbers, *(column[kept] for column in columns))


@dataclass(frozen=True, slots=True, repr=False)
class Uncertainty(ShortRepr):
    """Standard deviations of frames, earliest first; infinite where nothing is known."""

    timestamps: Float[np.ndarray, "n"]
    """Seconds."""
    position: Annotated[Float[np.ndarray, "n"], UNBOUNDED]
    """Camera's centre, map units, all axes together: the error left after the trajectory is
    aligned with the truth by a similarity."""
    rotation: Annotated[Float[np.ndarray, "n"], UNBOUNDED]
    """Orientation, radians."""
    depth: Annotated[Float[np.ndarray, "n"], UNBOUNDED]
    """Depths, relative, where the trajectory is as long as the true one: those of the best known
    15 % of what the frame sees, as bare walls say nothing."""
    focal: AtLeast0 = 0.0
    """Focal length, relative: the width of things over their depth."""
    misfit: AtLeast0 = 0.0
    """Residuals of the tenth of the keyframes whose matches fit least, over those of the usual
    keyframe; 0 where that is not known."""
    focal_change: AtLeast0 = 0.0
    """Relative difference of the focal lengths that parts of the video fit best."""
    lens_change: AtLeast0 = 0.0
    """Part of the cost of the matches that is left because the lens changes from frame to frame."""
    joined: Annotated[float, Range(0, 1)] = 1.0
    """Fraction of the keyframes in the largest part that one rigid structure holds together."""
    lens_varies: bool = False
    """Whether lenses of the frames' own were found, and taken off the matches."""

    def at(self, timestamps: Float[np.ndarray, "m"]) -> "Uncertainty":
        """Interpolated in time, constant beyond the ends; infinite where there is nothing."""
        known = (self.position, self.rotation, self.depth)
        if not len(self.timestamps):
            position, rotation, depth = (np.full(len(timestamps), np.inf) for _ in known)
        else:
            position, rotation, depth = (np.interp(timestamps, self.timestamps, c) for c in known)
        return replace(
            self, timestamps=timestamps, position=position, rotation=rotation, depth=depth
        )

    def with_found(self, found: FoundFrames) -> "Uncertainty":
        """With frames that were found afterwards: their own deviations add to those of the frames
        around them, as independent ones."""
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
class MapSnapshot(ShortRepr):
    """The disks of a map as plain numbers, detached from training."""

    position: Float[Tensor, "n 3"]
    quaternion: Float[Tensor, "n 4"]
    """w, x, y, z, unit norm."""
    scale: Float[Tensor, "n 2"]
    """Standard deviations along the two tangents, map units."""
    opacity: Float[Tensor, "n"]
    """In (0, 1)."""

    def __len__(self) -> int:
        return len(self.position)

    @property
    def normal(self) -> Float[Tensor, "n 3"]:
        """Third axis of each disk, world frame."""
        return quaternion_to_matrix(self.quaternion)[..., 2]

    def in_world(self, origin: Float64[np.ndarray, "3"], unit: float) -> "MapSnapshot":
        """The disks of a map whose origin lies there in the world, and whose unit is so long."""
        position = self.position * unit + torch.from_numpy(origin).to(self.position)
        return MapSnapshot(position, self.quaternion, self.scale * unit, self.opacity)

    def is_finite(self) -> bool:
        """Whether every number is finite."""
        parts = (self.position, self.quaternion, self.scale, self.opacity)
        return all(bool(torch.isfinite(p).all()) for p in parts)


@dataclass(frozen=True, slots=True, repr=False)
class RenderedKeyframe(ShortRepr):
    """The map seen from a keyframe: what a surface is made from."""

    keyframe_id: int
    camera: Camera
    """Camera of the maps."""
    T_cw: Float[Tensor, "4 4"]
    """World to camera, float64."""
    depth: Float[Tensor, "h w"]
    """Map units; 0 where the map is too thin to say."""
    normal: Float[Tensor, "h w 3"]
    """Camera frame, facing the camera, zero where there is no depth."""
    weight: Float[Tensor, "h w"]
    """Confidence of the depth in [0, 1]; less where disks spread along the ray."""
    image: UInt8[np.ndarray, "h2 w2 3"] | None
    """RGB at working resolution; none in a result that was written without images."""
    timestamp: float
    """Seconds."""
    mask: Bool[Tensor, "h w"] | None = None
    """Pixels that belong to the scene; none where all do."""
