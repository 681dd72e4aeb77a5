"""What flows between the parts: frozen records, no behaviour."""

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Float16, Float32, UInt8
from torch import Tensor

from geogs.config.setting import Range
from geogs.geometry.camera import Camera
from geogs.geometry.lie import quaternion_to_matrix
from geogs.limits import UNBOUNDED, AtLeast0, Pose, Positive
from geogs.short_repr import ShortRepr


@runtime_checkable
class MeasuredDepth(Protocol):
    """What a depth sensor saw, read when it is asked for."""

    def metres(self) -> Float32[np.ndarray, "h w"] | None:
        """Depth z of every pixel, 0 where unknown; None where it cannot be read."""
        ...


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class MeasuredPose(ShortRepr):
    """Where something else than the images says that the camera was."""

    T_cw: Pose
    """World to camera, metres, in a world of its own."""
    world: int = 0
    """Poses of different worlds say nothing of each other."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class SeenRows(ShortRepr):
    """Where and when a rolling shutter saw what an image shows whose rows were rectified.

    The nodes lie in the middle of each eight pixels, and a step beyond the border; the image was
    made with what lies between them bilinearly.
    """

    offset: Float16[Tensor, "r c 2"]
    """Pixels from a node to where a pinhole at the camera's place of that time saw the same."""
    seconds: Float16[Tensor, "r c"]
    """That time, from the middle row's."""
    doubt: float = 0.0
    """Standard error of the readout, as a part of it; 0 where it was told."""
    is_rectified: bool = True
    """Else rows are as they came, and ``seconds`` those of a readout of one standard error: the
    shutter is taken for global, and may not be."""


@dataclass(frozen=True)
class FlowMatch:
    """Where the cells of one image lie in another."""

    pixels: Float32[Tensor, "e p 2"]
    """Position in the second image of each grid cell of the first."""
    weight: Annotated[Float32[Tensor, "e p 2"], Range(0)]
    """Inverse variance of x and y in 1 / pixel^2; zero where there is no match."""
    damping: Annotated[Float32[Tensor, "e p"], Range(0)] | None = None
    """What resists a change of the first image's inverse depth, in the units of its inverse
    variance; equal for all edges of a call that share the first image. None for nothing."""
    memory: tuple[Any, ...] | None = field(default=None, metadata={"stored": False})
    """What the operator wants to be given when it measures an edge again, of each."""

    def on_cpu(self) -> "FlowMatch":
        """Positions and weights alone, on the CPU."""
        return FlowMatch(self.pixels.cpu(), self.weight.cpu())

    def sure(self) -> Bool[Tensor, "e p"]:
        """Cells that a geometry may be guessed from: matched, along both axes, with no less than a
        hundredth of the weight of the edge's best, where a mere guess would count like a good
        match."""
        weight = self.weight.amin(-1)
        best = torch.quantile(weight.float(), 0.98, dim=-1, keepdim=True)
        return (weight > 0) & (weight > 0.01 * best)

    def only_sure(self) -> "FlowMatch":
        """Positions and weights, those of cells alone that a geometry may be guessed from."""
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
    """By another tracker, where there is one and it is to be used as a prior."""
    rows: SeenRows | None = None
    """How its rows were rectified; none of a global shutter."""
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
    """Whether everything was adjusted together, as a bundle adjustment of all keyframes does; else
    those before the place where it begins were not."""


@dataclass(frozen=True, slots=True)
class MetricScale:
    """By what the lengths of a map are metres."""

    origin: str
    """What told them."""
    factor: Positive
    """By which all lengths were multiplied."""
    deviation: AtLeast0
    """Standard deviation of the factor, as a part of it."""


@dataclass(frozen=True, slots=True)
class FoundLens:
    """OpenCV's k1 and k2 that all matches found in images that were taken for those of a pinhole,
    and its focal length.

    A ray x, y was seen at focal (1 + k1 r^2 + k2 r^4) times that, about a principal point.
    """

    k1: float
    k2: float
    deviation_k1: AtLeast0
    """Standard deviation."""
    deviation_k2: AtLeast0
    focal: Positive = 1.0
    """The focal length over what it was taken for; 1 where that was not asked, or is right."""
    deviation_focal: AtLeast0 = 0.0
    right: float = 0.0
    down: float = 0.0
    """Where the principal point lies off what it was taken for, in the focal lengths found."""
    deviation_centre: AtLeast0 = 0.0
    varies_focal: AtLeast0 = 0.0
    varies_centre: AtLeast0 = 0.0
    """What frames have of their own, focal lengths as parts of that and principal points in it;
    root mean square over the frames, zero where all are alike."""

    @property
    def varies(self) -> bool:
        """Whether frames have lenses of their own."""
        return self.varies_focal > 0 or self.varies_centre > 0

    @property
    def is_off_centre(self) -> bool:
        """Whether the principal point was corrected."""
        return self.right != 0 or self.down != 0

    def of_frame(self, own: "FrameLens") -> "FoundLens":
        """That of a frame which has something of its own."""
        focal = self.focal * math.exp(own.focal)
        return replace(self, focal=focal, right=self.right + own.right, down=self.down + own.down)


@dataclass(frozen=True)
class FrameLens:
    """What the lens of one frame has of its own, beside that of all."""

    focal: float = 0.0
    """Logarithm of its focal length over that of all."""
    right: float = 0.0
    down: float = 0.0
    """Where its principal point lies off theirs, in focal lengths."""

    @property
    def sizes(self) -> tuple[float, float, float]:
        """All three."""
        return self.focal, self.right, self.down

    def plus(self, other: "FrameLens") -> "FrameLens":
        """With what was found beside."""
        right, down = self.right + other.right, self.down + other.down
        return FrameLens(self.focal + other.focal, right, down)


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
        """The frames of which so much is known and no more."""
        keep = np.array([known == state for known in self.states], bool)
        return Trajectory(self.timestamps[keep], self.T_wc[keep], self.tracked[keep])


@dataclass(frozen=True, slots=True, repr=False)
class FoundFrames(ShortRepr):
    """Frames of a video that had no place, and have one after all, in time order."""

    numbers: tuple[int, ...]
    """Which frames of the video they are: the rows of what follows."""
    timestamps: Float[np.ndarray, "n"]
    """Seconds."""
    T_cw: Float[np.ndarray, "n 4 4"]
    """World to camera, float64."""
    position: Float[np.ndarray, "n"]
    """Standard deviation of the camera's centre beside the frames that had a place before, map
    units; infinite where that is not known."""
    rotation: Float[np.ndarray, "n"]
    """The same of its orientation, radians."""

    @staticmethod
    def none() -> "FoundFrames":
        """Of no frame."""
        return FoundFrames((), np.zeros(0), np.zeros((0, 4, 4)), np.zeros(0), np.zeros(0))

    def __len__(self) -> int:
        return len(self.numbers)

    def of(self, kept: Bool[np.ndarray, "n"]) -> "FoundFrames":
        """Some of them."""
        numbers = tuple(n for n, is_kept in zip(self.numbers, kept, strict=True) if is_kept)
        columns = (self.timestamps, self.T_cw, self.position, self.rotation)
        return FoundFrames(numbers, *(column[kept] for column in columns))


@dataclass(frozen=True, slots=True, repr=False)
class Uncertainty(ShortRepr):
    """Standard deviations of frames, earliest first; infinite where nothing is known."""

    timestamps: Float[np.ndarray, "n"]
    """Seconds."""
    position: Annotated[Float[np.ndarray, "n"], UNBOUNDED]
    """That of the camera's centre, map units, all axes together: of what is left when the
    trajectory is laid over the truth by a similarity."""
    rotation: Annotated[Float[np.ndarray, "n"], UNBOUNDED]
    """That of its orientation, radians."""
    depth: Annotated[Float[np.ndarray, "n"], UNBOUNDED]
    """That of its depths, as a part of them, where the trajectory is as long as the true one: of
    the best known quarter of what it sees, as bare walls tell nothing."""
    focal: AtLeast0 = 0.0
    """That of the focal length, as a part of it: of the width of things over their depth."""
    misfit: AtLeast0 = 0.0
    """How many times as long as the usual keyframe's are the residuals of the tenth whose matches
    fit least; 0 where that is not known."""
    focal_change: AtLeast0 = 0.0
    """By how much parts of the video want focal lengths that differ, as a part of them."""
    lens_change: AtLeast0 = 0.0
    """Part of the cost of the matches that is left because the lens changes from frame to frame."""

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
        """With frames that were found beside these: each is as far off as those around it, and by
        its own deviations, which are independent."""
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
    """How far the depth may be trusted, in [0, 1]; less where disks spread along the ray."""
    image: UInt8[np.ndarray, "h2 w2 3"] | None
    """RGB at working resolution; none in a result that was written without images."""
    timestamp: float
    """Seconds."""
    mask: Bool[Tensor, "h w"] | None = None
    """Pixels that belong to the scene; none where all do."""
