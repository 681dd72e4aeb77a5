"""A keyframe as the depth estimation needs it, and its dense depth."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, UInt8
from torch import Tensor

from geogs.geometry.camera import Camera

INFINITY = 1e6
"""Factor on a depth that stands for infinity."""


@dataclass(frozen=True, slots=True, eq=False)
class ViewPose:
    """Id and pose of a keyframe."""

    id: int
    """The keyframe's id."""
    T_cw: Float64[np.ndarray, "4 4"]
    """World to camera."""

    @property
    def center(self) -> Float64[np.ndarray, "3"]:
        """Camera centre in the world."""
        return -self.T_cw[:3, :3].T @ self.T_cw[:3, 3]

    @property
    def forward(self) -> Float64[np.ndarray, "3"]:
        """Viewing direction in the world."""
        return self.T_cw[2, :3]


@dataclass(frozen=True, slots=True, eq=False)
class DepthView(ViewPose):
    """One keyframe: images, pose, and the tracker's depth on its grid."""

    grey: Float32[np.ndarray, "h w"]
    """Grey image in [0, 1] at the render size, where planes are swept."""
    fine: Float32[np.ndarray, "fh fw"]
    """Grey image in [0, 1] at the working size, a little blurred, where depth is refined."""
    image: UInt8[np.ndarray, "wh ww 3"]
    """RGB at the working size."""
    inverse_depth: Float32[np.ndarray, "gh gw"]
    """Inverse depth of the tracker, on its grid; per map unit."""
    information: Float32[np.ndarray, "gh gw"]
    """Sum over edges of w |dp/dd|^2; 0 where the tracker has no depth."""


@dataclass(slots=True)
class KeyframeDepth:
    """Dense depth of one keyframe at the render size."""

    depth: Float32[np.ndarray, "h w"]
    """z in map units; positive everywhere."""
    confidence: Float32[np.ndarray, "h w"]
    """About the chance, in [0, 1], that the depth is right to 2 %."""


@dataclass(frozen=True, slots=True, eq=False)
class DenseDepth:
    """A keyframe's dense depth on the device of the map."""

    depth: Float32[Tensor, "h w"]
    """z in map units; positive everywhere."""
    confidence: Float32[Tensor, "h w"]
    """About the chance, in [0, 1], that the depth is right to 2 %."""
    median: Float32[Tensor, ""]
    """About the median depth, in host memory; read it as ``typical``."""
    written: torch.cuda.Event | None = None
    """Event after which a GPU has written the median."""
    normal: Float32[Tensor, "h w 3"] | None = None
    """Unit, camera frame, facing the camera; zero where unknown."""
    sky: Bool[Tensor, "h w"] | None = None
    """Pixels without a surface at any depth; their confidence is 0."""

    @staticmethod
    def of(depth: KeyframeDepth) -> "DenseDepth":
        """Wrap the same memory as CPU tensors."""
        return DenseDepth(
            torch.from_numpy(depth.depth),
            torch.from_numpy(depth.confidence),
            torch.tensor(np.median(depth.depth)),
        )

    @property
    def typical(self) -> float:
        """About the median depth, map units."""
        if self.written is not None:
            self.written.synchronize()
        return float(self.median)

    def arrays(self) -> KeyframeDepth:
        """The same as arrays, in the same memory where the tensors are on the CPU."""
        return KeyframeDepth(self.depth.cpu().numpy(), self.confidence.cpu().numpy())

    def within(self, mask: Bool[Tensor, "h w"]) -> "DenseDepth":
        """The depth with confidence 0 outside the mask; the median is that of the inside."""
        inside = self.depth[mask]
        confidence = torch.where(mask, self.confidence, 0.0)
        if not len(inside):
            return replace(self, confidence=confidence)
        return replace(self, confidence=confidence, median=inside.median().cpu(), written=None)

    def unknown_in(self, mask: Bool[Tensor, "h w"]) -> "DenseDepth":
        """The depth with confidence 0 in the mask. Depth and median stay."""
        confidence = torch.where(mask.to(self.confidence.device), 0.0, self.confidence)
        return replace(self, confidence=confidence)

    def under(self, sky: Bool[Tensor, "h w"] | None) -> "DenseDepth":
        """The depth with the given sky, if any."""
        if sky is None:
            return self
        return replace(self.unknown_in(sky), sky=sky)

    def through_sky(self) -> "DenseDepth":
        """The depth with its sky behind everything, at confidence 1."""
        if self.sky is None:
            return self
        far = torch.where(self.sky, INFINITY * self.depth, self.depth)
        return replace(self, depth=far, confidence=torch.where(self.sky, 1.0, self.confidence))

    def scaled(self, factor: float) -> "DenseDepth":
        """The depth multiplied by a factor."""
        depth = self.depth * factor
        median = torch.tensor(np.median(depth.cpu().numpy()))
        return replace(self, depth=depth, median=median, written=None)


@dataclass(frozen=True, slots=True, eq=False)
class PosedDepth:
    """A dense depth and its camera pose."""

    T_cw: Float64[np.ndarray, "4 4"]
    """World to camera."""
    depth: DenseDepth


def depth_images(
    image: UInt8[np.ndarray, "wh ww 3"], render: Camera
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "fh fw"]]:
    """``grey`` and ``fine`` of a view with that image, for depths at the size of ``render``."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) * np.float32(1 / 255)
    small = cv2.resize(grey, (render.width, render.height), interpolation=cv2.INTER_AREA)
    return small, cv2.GaussianBlur(grey, (0, 0), 0.7)


def relative_poses(
    reference: DepthView, neighbours: Sequence[DepthView]
) -> Float[np.ndarray, "n 4 4"]:
    """Transformations from the reference's camera to the neighbours'."""
    return np.stack([v.T_cw for v in neighbours]) @ np.linalg.inv(reference.T_cw)


def homographies(
    reference: DepthView, neighbours: Sequence[DepthView], source: Camera, target: Camera
) -> tuple[Float64[np.ndarray, "n 3 3"], Float64[np.ndarray, "n 3"]]:
    """a and b: pixel p of the reference's ``source`` camera at inverse depth rho appears at
    a p + rho b (homogeneous) in each neighbour's ``target`` camera.
    """
    k = target.matrix().numpy()
    back = np.linalg.inv(source.matrix().numpy())
    relative = relative_poses(reference, neighbours)
    return k @ relative[:, :3, :3] @ back, relative[:, :3, 3] @ k.T


def dense_depths(maps: Sequence[tuple[Tensor, Tensor]]) -> list[DenseDepth]:
    """Join depths and confidences with medians, for which the host does not wait for a GPU."""
    if not maps:
        return []
    medians = torch.stack([depth.flatten().median() for depth, _ in maps])
    written = None
    if medians.is_cuda:
        on_host = torch.empty(len(maps), pin_memory=True)
        medians = on_host.copy_(medians, non_blocking=True)
        written = torch.cuda.Event()
        written.record(torch.cuda.current_stream(maps[0][0].device))
    return [DenseDepth(*m, median, written) for m, median in zip(maps, medians, strict=True)]
