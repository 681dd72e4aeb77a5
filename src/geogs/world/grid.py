"""The sparse sample grid on which the tracker keeps inverse depth and flow."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from geogs.camera.shutter.rows import node_count
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.gpu.transfer import to_device

STRIDE = 8
"""Pixels of the working image between two cells of the grid."""
OFFSET = 4
"""Pixel of the working image that the first cell samples."""


@dataclass(frozen=True)
class SampleGrid:
    """Cells ``(r, c)`` at pixels ``(4 + 8 c, 4 + 8 r)`` of the working image, row by row."""

    camera: Camera
    device: torch.device | str = "cpu"
    width: int = field(init=False)
    """Cells per row."""
    height: int = field(init=False)
    """Rows."""
    pixels: Float[Tensor, "p 2"] = field(init=False)
    """x, y of each cell, float32."""
    rays: Float[Tensor, "p 3"] = field(init=False)
    """Viewing ray of each cell, to depth 1, float32."""
    centre: Float[Tensor, "2"] = field(init=False)
    """Half of the image's width and height, float32."""

    def __post_init__(self) -> None:
        x = torch.arange(OFFSET, max(self.camera.width - 3, OFFSET), STRIDE, dtype=torch.float64)
        y = torch.arange(OFFSET, max(self.camera.height - 3, OFFSET), STRIDE, dtype=torch.float64)
        if len(x) < 4 or len(y) < 4:
            raise InputError(
                f"The working image is {self.camera.width} x {self.camera.height} pixels; "
                "tracking needs at least 32 x 32."
            )
        yy, xx = torch.meshgrid(y, x, indexing="ij")
        cam = self.camera
        pixels = torch.stack([xx, yy], -1)
        rays = torch.cat([cam.plane(pixels), torch.ones_like(pixels[..., :1])], -1)
        object.__setattr__(self, "width", len(x))
        object.__setattr__(self, "height", len(y))
        object.__setattr__(self, "pixels", pixels.reshape(-1, 2).float().to(self.device))
        object.__setattr__(self, "rays", rays.reshape(-1, 3).float().to(self.device))
        centre = torch.tensor([cam.width / 2, cam.height / 2])
        object.__setattr__(self, "centre", centre.to(self.device))

    @property
    def sizes(self) -> dict[str, int]:
        """Sizes by the letters in the shapes of stored arrays: ``p`` cells, ``s`` cells in every
        second row and column, images of ``h w`` pixels, rectified by ``r c`` nodes."""
        camera = self.camera
        size = {"p": self.size, "h": camera.height, "w": camera.width}
        some = -(-self.height // 2) * -(-self.width // 2)
        return size | {"s": some, "r": node_count(camera.height), "c": node_count(camera.width)}

    @property
    def on_gpu(self) -> bool:
        """Whether fields on the grid are on a GPU."""
        return torch.device(self.device).type == "cuda"

    @property
    def size(self) -> int:
        """Number of cells."""
        return self.width * self.height

    def inside(self, points: Float[Tensor, "*b 2"], margin: float = 1.0) -> Bool[Tensor, "*b"]:
        """Whether pixel positions lie in the image, ``margin`` pixels from its border."""
        x, y = points.unbind(-1)
        right, bottom = self.camera.width - 1 - margin, self.camera.height - 1 - margin
        return (x >= margin) & (x <= right) & (y >= margin) & (y <= bottom)

    def sample_field(
        self, values: Float[Tensor, "p c"], points: Float[Tensor, "n 2"]
    ) -> Float[Tensor, "n c"]:
        """Interpolate a field on the grid bilinearly at any pixels; replicated at the border."""
        cells = (points - OFFSET) / STRIDE
        sides = (self.width - 1, self.height - 1)
        normalised = torch.stack([cells[:, k] * (2 / sides[k]) - 1 for k in (0, 1)], -1)
        image = values.mT.reshape(1, -1, self.height, self.width)
        out = torch.nn.functional.grid_sample(
            image, normalised[None, None], align_corners=True, padding_mode="border"
        )
        return out[0, :, 0].mT

    def cells_of(self, points: Float[Tensor, "*b 2"]) -> tuple[Tensor, Bool[Tensor, "*b"]]:
        """Return the index of the cell nearest to each pixel position, and whether there is one."""
        cell = torch.round((points.nan_to_num(-1e4).clamp(-1e4, 1e5) - OFFSET) / STRIDE).long()
        c, r = cell.unbind(-1)
        valid = (c >= 0) & (c < self.width) & (r >= 0) & (r < self.height)
        return torch.where(valid, r * self.width + c, torch.zeros_like(c)), valid

    def enlarged(self, values: Shaped[Tensor, "p"], width: int, height: int) -> Tensor:
        """Resize a field to an image of the whole view; each pixel gets its nearest cell."""
        rows, columns = (
            to_device(_nearest(size, whole, cells), values.device)
            for size, whole, cells in (
                (height, self.camera.height, self.height),
                (width, self.camera.width, self.width),
            )
        )
        return values.view(self.height, self.width)[rows][:, columns]


def _nearest(size: int, whole: int, cells: int) -> Int[Tensor, "n"]:
    """Return the index of the cell nearest to each of ``size`` pixels along an axis."""
    position = (torch.arange(size) + 0.5) * (whole / size) - 0.5
    return torch.round((position - OFFSET) / STRIDE).long().clamp(0, cells - 1)
