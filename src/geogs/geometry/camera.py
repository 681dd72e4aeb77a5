"""Camera model: a pinhole, or with radial distortion; pixel centres at integer coordinates."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from geogs.errors import InputError

LEAST_SLOPE = 0.1
"""Least slope of the distorted radius; below it the image folds over."""


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels; the centre of pixel (0, 0) is (0, 0).

    Pixel = c + f x (1 + k1 |x|^2 + k2 |x|^4), x = (X / Z, Y / Z): OpenCV's model with k1 and k2
    alone. Without them it is a pinhole, and images are undistorted. Only tracking accepts
    distortion: depth search, renderer, mesh and textures need pinholes.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    k1: float = 0.0
    k2: float = 0.0

    def __post_init__(self) -> None:
        """Raises InputError for numbers that are none of a camera."""
        try:
            is_finite = all(map(math.isfinite, self.numbers))
            is_image = all(n >= 1 and float(n).is_integer() for n in (self.width, self.height))
        except (TypeError, ValueError):
            is_finite = is_image = False
        if not (is_finite and is_image and self.fx > 0 and self.fy > 0):
            raise InputError(
                f"There is no camera with fx {self.fx}, fy {self.fy}, cx {self.cx}, cy {self.cy}, "
                f"k1 {self.k1} and k2 {self.k2} for images of {self.width} x {self.height}; focal "
                "lengths and sizes are positive, all numbers finite."
            )

    @property
    def long_edge(self) -> int:
        """Pixels along the longer side of the image."""
        return max(self.width, self.height)

    @property
    def numbers(self) -> tuple[float, ...]:
        """fx, fy, cx, cy, k1 and k2, for kernels."""
        return self.fx, self.fy, self.cx, self.cy, self.k1, self.k2

    @property
    def K(self) -> Float[np.ndarray, "3 3"]:
        """Intrinsic matrix, float64."""
        return self.matrix().numpy()

    def matrix(self) -> Float[Tensor, "3 3"]:
        """Return K in float64."""
        rows = [[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
        return torch.tensor(rows, dtype=torch.float64)

    def resized(self, width: int, height: int) -> "Camera":
        """Return the camera of the image resized to ``width x height``; the image plane is kept.

        A pixel covers [x - 1/2, x + 1/2], so coordinates shift by half a pixel before and after
        the scaling.
        """
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
            width=width,
            height=height,
        )

    def with_long_edge(self, long_edge: int) -> "Camera":
        """Return the camera of the image scaled to ``long_edge`` pixels along its longer side."""
        scale = long_edge / self.long_edge
        width, height = round(self.width * scale), round(self.height * scale)
        return self.resized(max(width, 1), max(height, 1))

    def with_focal(self, focal: float) -> "Camera":
        """Return the camera with fx = ``focal`` and the same aspect."""
        return replace(self, fx=focal, fy=focal * self.fy / self.fx)

    def with_field_of_view(self, degrees: float) -> "Camera":
        """Return the camera with this field of view along its longer side.

        Raises InputError unless it is above 0 and below 180 degrees.
        """
        if not 0 < degrees < 180:
            raise InputError(f"No lens sees {degrees:g} degrees; give more than 0 and below 180.")
        return self.with_focal(self.long_edge / 2 / math.tan(math.radians(degrees / 2)))

    def moved(
        self,
        log_focal: float,
        k1: float = 0.0,
        k2: float = 0.0,
        right: float = 0.0,
        down: float = 0.0,
    ) -> "Camera":
        """Return the camera with the focal length times ``exp(log_focal)``, ``k1`` and ``k2`` added
        to the radial terms, and its principal point moved, in its focal lengths."""
        factor = math.exp(log_focal)
        fx, fy = factor * self.fx, factor * self.fy
        cx, cy = self.cx + right * fx, self.cy + down * fy
        return replace(self, fx=fx, fy=fy, cx=cx, cy=cy, k1=self.k1 + k1, k2=self.k2 + k2)

    def moves_from(self, other: "Camera") -> tuple[float, float, float, float, float]:
        """Return the arguments by which :meth:`moved` makes this camera from another."""
        right, down = (self.cx - other.cx) / self.fx, (self.cy - other.cy) / self.fy
        return math.log(self.fx / other.fx), self.k1 - other.k1, self.k2 - other.k2, right, down

    # --- distortion ------------------------------------------------------------------------

    @property
    def is_pinhole(self) -> bool:
        """Whether it has no radial terms."""
        return not (self.k1 or self.k2)

    @property
    def pinhole(self) -> "Camera":
        """The same camera without radial terms."""
        return replace(self, k1=0.0, k2=0.0)

    def required_pinhole(self) -> "Camera":
        """Return itself. Raises InputError if it has radial terms: maps need a pinhole."""
        if not self.is_pinhole:
            raise InputError(
                f"The camera bends rays (k1 {self.k1:g}, k2 {self.k2:g}); undistort its images, "
                "and give the pinhole that sees them."
            )
        return self

    def growth(self, square: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """Return the factor on a ray's distance from the axis, whose square is given."""
        return 1 + square * (self.k1 + square * self.k2)

    def steepness(self, square: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """Return the slope of the distorted radius over the radius: 1 + 3 k1 r^2 + 5 k2 r^4, at
        least ``LEAST_SLOPE``."""
        return (1 + square * (3 * self.k1 + 5 * square * self.k2)).clamp(min=LEAST_SLOPE)

    def bent(self, plane: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
        """Distort points x / z, y / z; in focal lengths from the principal point."""
        return plane * self.growth(plane.square().sum(-1, keepdim=True))

    def straight(self, bent: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
        """Undistort to points x / z, y / z; source: Newton's method on the radius."""
        if self.is_pinhole:
            return bent
        s = radius = bent.norm(dim=-1, keepdim=True)
        for _ in range(8):
            square = s.square()
            s = s - (s * self.growth(square) - radius) / self.steepness(square)
        return bent / self.growth(s.square())

    def plane(self, pixels: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
        """Return the points x / z, y / z of pixels."""
        x, y = (pixels[..., 0] - self.cx) / self.fx, (pixels[..., 1] - self.cy) / self.fy
        return self.straight(torch.stack([x, y], -1))

    def pixels(self, plane: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
        """Return the pixels of points x / z, y / z: the inverse of :meth:`plane`."""
        x, y = self.bent(plane).unbind(-1)
        return torch.stack([self.fx * x + self.cx, self.fy * y + self.cy], -1)

    def bend_jacobian(
        self, plane: Float[Tensor, "*b 2"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"], Float[Tensor, "*b"]]:
        """Return the derivatives of :meth:`bent`: of x by x, of either by the other, of y by y."""
        x, y = plane.unbind(-1)
        square = x * x + y * y
        growth = self.growth(square)
        slope = 2 * self.k1 + 4 * self.k2 * square
        return growth + slope * x * x, slope * x * y, growth + slope * y * y

    # --- points ----------------------------------------------------------------------------

    def rays(
        self, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
    ) -> Float[Tensor, "h w 3"]:
        """Return the point at depth 1 of every pixel; for a pinhole K^-1 (u, v, 1)."""
        u = (torch.arange(self.width, dtype=torch.float64, device=device) - self.cx) / self.fx
        v = (torch.arange(self.height, dtype=torch.float64, device=device) - self.cy) / self.fy
        v, u = torch.meshgrid(v, u, indexing="ij")
        u, v = self.straight(torch.stack([u, v], -1)).unbind(-1)
        return torch.stack([u, v, torch.ones_like(u)], -1).to(dtype)

    def project(
        self, points: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b 2"], Float[Tensor, "*b"]]:
        """Return pixels and depths of camera-frame points; pixels are valid only where z > 0."""
        x, y, z = points.unbind(-1)
        safe = torch.where(z.abs() < 1e-9, torch.full_like(z, 1e-9), z)
        if not self.is_pinhole:
            x, y = (safe * self.bent(torch.stack([x / safe, y / safe], -1)).movedim(-1, 0)).unbind()
        return torch.stack([self.fx * x / safe + self.cx, self.fy * y / safe + self.cy], -1), z

    def back_project(self, depth: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b h w 3"]:
        """Return the camera-frame points of a depth map."""
        return depth[..., None] * self.rays(depth.dtype, depth.device)
