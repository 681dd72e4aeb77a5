"""Coloured disks through the CUDA operators of gsplat (Apache-2.0)."""

from types import ModuleType

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bench.appearance.disks import AppearanceDisks
from geogs.bench.appearance.rasteriser import MedianDisks, Rendering, shifted_matrix
from geogs.errors import DeviceError, InputError
from geogs.geometry.camera import Camera


def import_gsplat() -> ModuleType:
    """The package.

    Raises:
        InputError: it is not installed.
    """
    try:
        import gsplat
    except ImportError as error:
        raise InputError(
            "The appearance baseline needs gsplat; install it with: pip install gsplat"
        ) from error
    return gsplat


class GsplatRasteriser:
    """gsplat's ``rasterization_2dgs``; needs an NVIDIA GPU.

    Raises:
        InputError: gsplat is not installed.
        DeviceError: there is no GPU.
    """

    def __init__(self, near: float) -> None:
        self._rasterize = import_gsplat().rasterization_2dgs
        self._near = near
        self._matrices: dict[Camera, Tensor] = {}
        if not torch.cuda.is_available():
            raise DeviceError("The appearance baseline needs an NVIDIA GPU; there is none here.")

    def render(
        self,
        disks: AppearanceDisks,
        camera: Camera,
        T_cw: Float[Tensor, "4 4"],
        sh_degree: int,
        background: Float[Tensor, "3"] | None,
        with_normals: bool,
    ) -> Rendering:
        """As :class:`geogs.bench.appearance.rasteriser.Rasteriser` says."""
        colour, alpha, normal, depth_normal, _, _, meta = self._call(
            disks,
            camera,
            T_cw,
            colors=disks.coefficients,
            sh_degree=sh_degree,
            backgrounds=None if background is None else background[None],
            render_mode="RGB+ED" if with_normals else "RGB",
        )
        height, width = camera.height, camera.width
        screen = meta["gradient_2dgs"]
        return Rendering(
            colour[0, ..., :3],
            alpha[0, ..., 0],
            normal[0] if with_normals else None,
            depth_normal.reshape(height, width, 3) if with_normals else None,
            screen,
            (meta["radii"][0] > 0).all(-1),
        )

    @torch.no_grad()
    def median_disks(
        self, disks: AppearanceDisks, camera: Camera, T_cw: Float[Tensor, "4 4"]
    ) -> MedianDisks:
        """As :class:`geogs.bench.appearance.rasteriser.Rasteriser` says.

        gsplat's median is the last channel's value of the median disk, so that each disk is
        painted with its own number, from 1 on. Float32 holds these up to 2^24 disks.
        """
        if len(disks) >= 2**24:
            raise InputError(f"{len(disks)} disks are too many to tell apart; use fewer points.")
        device = disks.means.device
        numbers = torch.arange(1, len(disks) + 1, device=device, dtype=torch.float32)
        result = self._call(disks, camera, T_cw, colors=numbers[None, :, None], render_mode="RGB")
        alpha, median = result[1][0, ..., 0], result[5][0, ..., 0]
        index = median.round().long() - 1
        return MedianDisks(torch.where(alpha > 0, index, -1), alpha)

    def _call(
        self, disks: AppearanceDisks, camera: Camera, T_cw: Tensor, **options: object
    ) -> tuple:
        # The third scale is not used by the operators, but its column must be there.
        scales = torch.nn.functional.pad(disks.scales, (0, 1), value=1.0)
        return self._rasterize(
            means=disks.means,
            quats=disks.quaternions,
            scales=scales,
            opacities=disks.opacities,
            viewmats=T_cw[None],
            Ks=self._matrix(camera, T_cw.device)[None],
            width=camera.width,
            height=camera.height,
            near_plane=self._near,
            packed=False,
            **options,
        )

    def _matrix(self, camera: Camera, device: torch.device) -> Float[Tensor, "3 3"]:
        """Intrinsics on the device; kept, since sending them waits for the GPU."""
        if camera not in self._matrices:
            self._matrices[camera] = shifted_matrix(camera, device)
        return self._matrices[camera]
