"""Camera model: a pinhole, OpenCV's polynomial lens or its fisheye; pixel centres at integers."""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.errors import InputError

LEAST_SLOPE = 0.1
"""Least slope of the distorted radius; below it the image folds over."""
FISHEYE_LIMIT = math.radians(88.0)
"""Angle from the axis up to which the plane z = 1 is used; rays beyond are clamped to it."""


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels; the centre of pixel (0, 0) is (0, 0).

    A pixel is at c + f b(x) for a ray that meets the plane z = 1 at x, r = |x|:

    - a pinhole: b(x) = x;
    - OpenCV's polynomial: b(x) = x g + (2 p1 x y + p2 (r^2 + 2 x^2), p1 (r^2 + 2 y^2) + 2 p2 x y),
      g = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6);
    - a fisheye (Kannala and Brandt, PAMI 2006): b(x) = x g, with the angle a = atan r from the axis
      and g = a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8) / r.

    Tracking accepts all of them; depth search, renderer, mesh and textures need pinholes.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    is_fisheye: bool = False

    def __post_init__(self) -> None:
        """Raises InputError for numbers that are none of a camera."""
        try:
            is_finite = all(map(math.isfinite, self.numbers))
            is_image = all(n >= 1 and float(n).is_integer() for n in (self.width, self.height))
        except (TypeError, ValueError):
            is_finite = is_image = False
        if not (is_finite and is_image and self.fx > 0 and self.fy > 0):
            raise InputError(
                f"There is no camera with fx {self.fx}, fy {self.fy}, cx {self.cx}, cy {self.cy} "
                f"and distortion {self.distortion} for images of {self.width} x {self.height}; "
                "focal lengths and sizes are positive, all numbers finite."
            )

    @property
    def long_edge(self) -> int:
        """Pixels along the longer side of the image."""
        return max(self.width, self.height)

    @property
    def numbers(self) -> tuple[float, ...]:
        """fx, fy, cx, cy, the distortion, and 1 for a fisheye, for kernels."""
        return self.fx, self.fy, self.cx, self.cy, *self.distortion, float(self.is_fisheye)

    @property
    def distortion(self) -> tuple[float, ...]:
        """k1, k2, p1, p2, k3, k4, k5, k6: OpenCV's order for the polynomial."""
        return self.k1, self.k2, self.p1, self.p2, self.k3, self.k4, self.k5, self.k6

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
        """Whether it has no distortion."""
        return not (self.is_fisheye or any(self.distortion))

    @property
    def pinhole(self) -> "Camera":
        """The same camera without distortion."""
        return Camera(self.fx, self.fy, self.cx, self.cy, self.width, self.height)

    def required_pinhole(self) -> "Camera":
        """Return itself. Raises InputError if it has distortion: maps need a pinhole."""
        if not self.is_pinhole:
            raise InputError(
                f"The camera bends rays (distortion {self.distortion}); undistort its images, and "
                "give the pinhole that sees them."
            )
        return self

    def growth(self, square: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """Return the factor g on a ray's distance r from the axis, given r^2."""
        return self.radial_shapes(square)[0]

    def radial_shapes(
        self, square: Float[Tensor, "*b"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"], Float[Tensor, "*b"]]:
        """Return the growth, and its derivatives by k1 and k2."""
        if not self.is_fisheye:
            over = 1 + square * (self.k1 + square * (self.k2 + square * self.k3))
            under = 1 + square * (self.k4 + square * (self.k5 + square * self.k6))
            return over / under, square / under, square.square() / under
        angle, bend = self._angle(square)
        straight = angle / square.clamp(min=1e-30).sqrt()
        straight = torch.where(square > 0, straight, 1.0)
        second = angle.square()
        return straight * bend, straight * second, straight * second.square()

    def growth_slope(self, square: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """Return twice the derivative of the growth by r^2."""
        if not self.is_fisheye:
            over = 2 * self.k1 + square * (4 * self.k2 + 6 * square * self.k3)
            under = 1 + square * (self.k4 + square * (self.k5 + square * self.k6))
            more = 2 * self.k4 + square * (4 * self.k5 + 6 * square * self.k6)
            return (over - more * self.growth(square)) / under
        slope = self._angle_slope(square) / (1 + square)
        outer = (slope - self.growth(square)) / square.clamp(min=1e-4)
        return torch.where(square > 1e-4, outer, 2 * self.k1 - 2 / 3)  # to rounding at the axis

    def steepness(self, square: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """Return the slope of the distorted radius, by the radius or the angle of a fisheye; the
        image is folded over where it is not above ``LEAST_SLOPE``."""
        if self.is_fisheye:
            return self._angle_slope(square)
        return self.growth(square) + square * self.growth_slope(square)

    @cached_property
    def _widest_angle(self) -> float:
        """Angle from the axis up to which the image is not folded over, at most the limit."""
        angles = torch.linspace(0.0, FISHEYE_LIMIT, 1000, dtype=torch.float64)
        folded = torch.nonzero(self.steepness(angles.tan().square()) <= LEAST_SLOPE)
        return float(angles[folded[0, 0]]) if len(folded) else FISHEYE_LIMIT

    def _angle(self, square: Float[Tensor, "*b"]) -> tuple[Tensor, Tensor]:
        """Return the angle from the axis, and the factor by which a fisheye bends it."""
        angle = square.sqrt().atan()
        s = angle.square()
        return angle, 1 + s * (self.k1 + s * (self.k2 + s * (self.k3 + s * self.k4)))

    def _angle_slope(self, square: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """Return the derivative of a fisheye's radius by the angle."""
        s = square.sqrt().atan().square()
        return 1 + s * (3 * self.k1 + s * (5 * self.k2 + s * (7 * self.k3 + 9 * s * self.k4)))

    def bent(self, plane: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
        """Distort points x / z, y / z; in focal lengths from the principal point."""
        square = plane.square().sum(-1, keepdim=True)
        bent = plane * self.growth(square)
        if self.p1 or self.p2:
            both = 2 * plane.prod(-1, keepdim=True)
            aside = plane.new_tensor([self.p1, self.p2])
            along = square + 2 * plane.square()
            bent = bent + both * aside + along * aside.flip(-1)
        return bent

    def straight(self, bent: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
        """Undistort to points x / z, y / z; source: Newton's method on the radius, and then on the
        point where there are tangential terms. Where the lens shows nothing the farthest point that
        it shows that way is returned, or one at ``FISHEYE_LIMIT`` from the axis."""
        if self.is_pinhole:
            return bent
        radius = bent.norm(dim=-1, keepdim=True)
        widest = self._widest_angle
        if self.is_fisheye:
            angle = radius.clamp(max=widest)
            for _ in range(16):
                square = angle.tan().square()
                over = angle * self._angle(square)[1] - radius
                step = over / self._angle_slope(square).clamp(min=LEAST_SLOPE)
                angle = (angle - step).clamp(0.0, widest)
            return torch.where(radius > 0, bent * (angle.tan() / radius.clamp(min=1e-30)), bent)
        farthest = math.tan(widest)
        s = radius.clamp(max=farthest)
        for _ in range(8):
            square = s.square()
            slope = self.steepness(square).clamp(min=LEAST_SLOPE)
            s = (s - (s * self.growth(square) - radius) / slope).clamp(0.0, farthest)
        plane = torch.where(radius > 0, bent * (s / radius.clamp(min=1e-30)), bent)
        for _ in range(8 if self.p1 or self.p2 else 0):
            step = self.unbent_step(plane, bent - self.bent(plane))
            plane = plane + torch.where(self.shows(plane)[..., None], step.clamp(-1.0, 1.0), 0.0)
        return plane

    def plane(self, pixels: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
        """Return the points x / z, y / z of pixels."""
        x, y = (pixels[..., 0] - self.cx) / self.fx, (pixels[..., 1] - self.cy) / self.fy
        return self.straight(torch.stack([x, y], -1))

    def pixels(self, plane: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
        """Return the pixels of points x / z, y / z: the inverse of :meth:`plane`."""
        x, y = self.bent(plane).unbind(-1)
        return torch.stack([self.fx * x + self.cx, self.fy * y + self.cy], -1)

    def as_pinhole(self, pixels: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
        """Return where the same camera without distortion sees what is at some pixels."""
        return pixels if self.is_pinhole else self.pinhole.pixels(self.plane(pixels))

    def shows(self, plane: Float[Tensor, "*b 2"]) -> Bool[Tensor, "*b"]:
        """Whether the lens does not fold points x / z, y / z over."""
        return self.steepness(plane.square().sum(-1)) > LEAST_SLOPE

    def bend_jacobian(
        self, plane: Float[Tensor, "*b 2"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"], Float[Tensor, "*b"]]:
        """Return the derivatives of :meth:`bent`: of x by x, of either by the other, of y by y."""
        x, y = plane.unbind(-1)
        square = x * x + y * y
        growth = self.growth(square)
        slope = self.growth_slope(square)
        xx, xy, yy = growth + slope * x * x, slope * x * y, growth + slope * y * y
        if self.p1 or self.p2:
            xx = xx + 2 * self.p1 * y + 6 * self.p2 * x
            xy = xy + 2 * self.p1 * x + 2 * self.p2 * y
            yy = yy + 6 * self.p1 * y + 2 * self.p2 * x
        return xx, xy, yy

    def bent_step(
        self, plane: Float[Tensor, "*a 2"], step: Float[Tensor, "*b 2"]
    ) -> Float[Tensor, "*b 2"]:
        """Distort a small step of points x / z, y / z, to first order."""
        if self.is_pinhole:
            return step
        xx, xy, yy = self.bend_jacobian(plane)
        x, y = step.unbind(-1)
        return torch.stack([xx * x + xy * y, xy * x + yy * y], -1)

    def unbent_step(
        self, plane: Float[Tensor, "*a 2"], step: Float[Tensor, "*b 2"]
    ) -> Float[Tensor, "*b 2"]:
        """Return the small step of points x / z, y / z that is seen as a ``step`` of
        :meth:`bent`."""
        if self.is_pinhole:
            return step
        xx, xy, yy = self.bend_jacobian(plane)
        x, y = step.unbind(-1)
        return torch.stack([yy * x - xy * y, xx * y - xy * x], -1) / (xx * yy - xy * xy)[..., None]

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
