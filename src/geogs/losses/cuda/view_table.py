"""The keyframes' constants for the losses, on a GPU by slot."""

from collections.abc import Sequence
from enum import IntEnum

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.gpu.transfer import to_device
from geogs.losses.multi_view import PhotoView
from geogs.losses.single_view import ViewConstants


class ViewField(IntEnum):
    """Columns of the pointer table; the order of ``view_maps.cuh``."""

    EDGE = 0
    IMAGE_GRADIENT = 1
    PRIOR_DEPTH = 2
    CONFIDENCE = 3
    PRIOR_NORMAL = 4
    GREY = 5
    TEXTURE = 6
    RENDERED_DEPTH = 7


class ViewTable:
    """Maps and poses of keyframes on a device, one slot each, in any number.

    Kernels find them through ``pointers`` and ``poses``, so a captured graph works with any slots.
    Adding slots beyond the capacity replaces the tensors that have a row for each by larger ones
    and raises ``generation``: graphs captured before must be captured again.
    """

    def __init__(
        self, render: Camera, photo: Camera, device: torch.device, capacity: int = 64
    ) -> None:
        self.render = render
        self.photo = photo
        self.device = device
        self.generation = 0
        """Increases whenever ``pointers``, ``poses``, ``rendered`` and ``deviations`` become other
        tensors."""
        self.pointers: Int[Tensor, "slots fields"] = torch.zeros(
            capacity, len(ViewField), dtype=torch.int64, device=device
        )
        """Addresses of each slot's maps, 0 where it has none."""
        self.planes: list[Int[Tensor, "slots fields"]] = [self.pointers]
        """Pointers with each plane of the photometric image in place of the grey one, which comes
        first; colours if the first slot was given some."""
        self.poses: Float[Tensor, "slots 12"] = torch.zeros(
            capacity, 12, dtype=torch.float64, device=device
        )
        """T_cw, rows of the 3x4 matrix."""
        self.rendered: Int[Tensor, "slots"] = torch.zeros(
            capacity, dtype=torch.int32, device=device
        )
        """1 where the slot's rendered depth is known."""
        self.deviations: Float[Tensor, "slots"] = torch.zeros(capacity, device=device)
        """Standard deviation of the noise in the slots' grey values."""
        self._maps: list[Float[Tensor, "fields h w"]] = []
        self._normals: list[Float[Tensor, "3 h w"] | None] = []
        self._photos: list[Float[Tensor, "k ph pw"]] = []
        """Planes of each slot's photometric image, then its texture."""

    def __len__(self) -> int:
        return len(self._maps)

    def add(self, view: ViewConstants, photo: PhotoView) -> int:
        """Add a keyframe and return its slot."""
        slot = len(self)
        if slot == len(self.pointers):
            self._grow()
        size = (self.render.height, self.render.width)
        maps = torch.zeros(5, *size, device=self.device)
        planes = self._uploaded_photo(photo)
        self._maps.append(maps)
        self._normals.append(None)
        self._photos.append(planes)
        while len(self.planes) < len(planes) - 1:
            self.planes.append(torch.zeros_like(self.pointers))
        self._point(slot)
        self._set_noise(slot, photo)
        self.set_constants(slot, view)
        self.set_poses([slot], photo.T_cw[None])
        return slot

    def replace(self, slot: int, view: ViewConstants, photo: PhotoView) -> None:
        """Give a slot to another keyframe, whose rendering is not known yet.

        All maps stay where they are, so captured graphs remain valid.
        """
        self._maps[slot].zero_()
        self._photos[slot].copy_(self._uploaded_photo(photo))
        self.rendered[slot : slot + 1].zero_()
        self._set_noise(slot, photo)
        self.set_constants(slot, view)
        self.set_poses([slot], photo.T_cw[None])

    def set_constants(self, slot: int, view: ViewConstants) -> None:
        """Replace a keyframe's prior depth, confidence, prior normals and edges."""
        maps = [view.edge, view.image_gradient, view.prior_depth, view.confidence]
        self._maps[slot][:4].copy_(self._upload(torch.stack([m.float() for m in maps])))
        before = self._normals[slot]
        normal = view.prior_normal
        planes = None if normal is None else self._upload(normal.permute(2, 0, 1))
        if before is not None and planes is not None:
            before.copy_(planes)
        elif before is not planes:
            self._normals[slot] = planes
            self._point(slot)

    def set_poses(self, slots: Sequence[int], T_cw: Float[Tensor, "k 4 4"]) -> None:
        """Replace the world-to-camera poses of some slots, from a CPU or the device."""
        rows = T_cw.detach()[:, :3].reshape(-1, 12).double()
        index = to_device(torch.tensor(slots, dtype=torch.int64), self.device)
        self.poses.index_copy_(0, index, to_device(rows, self.device))

    def rendered_depth(self, slot: int) -> Float[Tensor, "h w"]:
        """The slot's rendered depth for occlusion tests; valid where ``rendered`` is 1."""
        return self._maps[slot][4]

    def forget_rendered(self) -> None:
        """Discard all rendered depths, as after the map has moved."""
        self.rendered.zero_()

    def _set_noise(self, slot: int, photo: PhotoView) -> None:
        self.deviations[slot : slot + 1].copy_(self._upload(photo.noise.sqrt()[None]))

    def _uploaded_photo(self, photo: PhotoView) -> Float[Tensor, "k ph pw"]:
        return self._upload(torch.cat([photo.planes, photo.texture[None]]))

    def _upload(self, tensor: Tensor) -> Tensor:
        return to_device(tensor.float().contiguous(), self.device)

    def _point(self, slot: int) -> None:
        """Write the addresses of a slot's maps, in the order of ``ViewField``."""
        edge, gradient, prior, confidence, rendered = (m.data_ptr() for m in self._maps[slot])
        normal = self._normals[slot]
        normals = 0 if normal is None else normal.data_ptr()
        *planes, texture = (m.data_ptr() for m in self._photos[slot])
        for pointers, plane in zip(self.planes, planes, strict=True):
            line = [edge, gradient, prior, confidence, normals, plane, texture, rendered]
            addresses = torch.tensor(line, dtype=torch.int64)
            pointers[slot].copy_(to_device(addresses, self.device))

    def _grow(self) -> None:
        """Double the capacity; the keyframes' maps stay where they are."""
        more = torch.zeros_like
        self.planes = [torch.cat([pointers, more(pointers)]) for pointers in self.planes]
        self.pointers = self.planes[0]
        self.poses = torch.cat([self.poses, more(self.poses)])
        self.rendered = torch.cat([self.rendered, more(self.rendered)])
        self.deviations = torch.cat([self.deviations, more(self.deviations)])
        self.generation += 1
