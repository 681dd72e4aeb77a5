"""The pinhole camera with pixel centres at integer coordinates."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels of an undistorted image; the centre of pixel (0, 0) is (0, 0)."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @property
    def long_edge(self) -> int:
        """Pixels along the longer side of the image."""
        return max(self.width, self.height)

    @property
    def K(self) -> Float[np.ndarray, "3 3"]:
        """Pixels of points at depth 1, float64."""
        return self.matrix().numpy()

    def matrix(self) -> Float[Tensor, "3 3"]:
        """K in float64."""
        rows = [[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
        return torch.tensor(rows, dtype=torch.float64)

    def resized(self, width: int, height: int) -> "Camera":
        """The camera of the image resized to ``width x height``; exact, the image plane is kept.

        A pixel covers [x - 1/2, x + 1/2], so coordinates shift by half a pixel before and after
        the scaling.
        """
        sx, sy = width / self.width, height / self.height
        return Camera(
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
            width=width,
            height=height,
        )

    def with_long_edge(self, long_edge: int) -> "Camera":
        """The camera of the image scaled so that its longer side has ``long_edge`` pixels."""
        scale = long_edge / self.long_edge
        width, height = round(self.width * scale), round(self.height * scale)
        return self.resized(max(width, 1), max(height, 1))

    def with_focal(self, focal: float) -> "Camera":
        """The camera with fx = ``focal`` and the same aspect."""
        return replace(self, fx=focal, fy=focal * self.fy / self.fx)

    def with_field_of_view(self, degrees: float) -> "Camera":
        """The camera with the focal length that sees so much along its longer side."""
        return self.with_focal(self.long_edge / 2 / math.tan(math.radians(degrees / 2)))

    def rays(
        self, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
    ) -> Float[Tensor, "h w 3"]:
        """K^-1 (u, v, 1) of every pixel: the point at depth 1."""
        u = (torch.arange(self.width, dtype=torch.float64, device=device) - self.cx) / self.fx
        v = (torch.arange(self.height, dtype=torch.float64, device=device) - self.cy) / self.fy
        v, u = torch.meshgrid(v, u, indexing="ij")
        return torch.stack([u, v, torch.ones_like(u)], -1).to(dtype)

    def project(
        self, points: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b 2"], Float[Tensor, "*b"]]:
        """Pixels and depths of camera-frame points; pixels mean something only where z > 0."""
        x, y, z = points.unbind(-1)
        safe = torch.where(z.abs() < 1e-9, torch.full_like(z, 1e-9), z)
        return torch.stack([self.fx * x / safe + self.cx, self.fy * y / safe + self.cy], -1), z

    def back_project(self, depth: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b h w 3"]:
        """Camera-frame points of a depth map."""
        return depth[..., None] * self.rays(depth.dtype, depth.device)
