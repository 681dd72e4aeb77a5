"""The pinhole that shows the images of a lens straight: as much of them as fits without border."""

import math
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.errors import InputError
from geogs.geometry.camera import Camera

FieldOfView = float | Literal["auto"]
"""Degrees along the longer side of a straight image."""
FISHEYE_VIEW = 90.0
"""Default field of view of a fisheye, degrees; a pinhole image would stretch more."""


def straight_camera(lens: Camera, field_of_view: FieldOfView = "auto") -> Camera:
    """Return the pinhole of the straightened images of a lens, of the same size.

    Its focal length is enlarged just enough that no pixel looks outside the image, so there are no
    black borders; of a fisheye it shows ``FISHEYE_VIEW`` at most; or it has the requested field of
    view. A pinhole is returned as it is, unless another field of view is requested.

    Raises InputError if the lens folds the image, or sees less than requested.
    """
    return zoomed(lens.pinhole, _zoom(lens, field_of_view))


def zoomed(camera: Camera, zoom: float) -> Camera:
    """Return a camera with its focal length multiplied by ``zoom``."""
    return camera if zoom == 1 else replace(camera, fx=camera.fx * zoom, fy=camera.fy * zoom)


def _zoom(lens: Camera, field_of_view: FieldOfView) -> float:
    """Return the factor on the focal length."""
    if field_of_view != "auto":
        return _zoom_to(field_of_view, lens)
    if lens.is_fisheye:
        return max(_zoom_for(FISHEYE_VIEW, lens), _least_zoom(lens))
    return 1.0 if lens.is_pinhole else _least_zoom(lens, 1.0)


def _zoom_to(degrees: float, lens: Camera) -> float:
    """Return the factor for a field of view. Raises InputError if the lens sees less."""
    zoom = _zoom_for(degrees, lens)
    if not _sees(lens, zoom) and zoom < (least := _least_zoom(lens)):
        most = 2 * math.degrees(math.atan(lens.long_edge / 2 / (least * lens.fx)))
        raise InputError(
            f"A straight image with a field of view of {degrees:g} degrees would show more than "
            f"the lens saw; give at most {math.floor(10 * most) / 10:g}."
        )
    return zoom


def _zoom_for(degrees: float, camera: Camera) -> float:
    """Return the factor on the focal length for a field of view along the longer side."""
    return camera.with_field_of_view(degrees).fx / camera.fx


def _least_zoom(lens: Camera, least: float = 0.05) -> float:
    """Return the smallest factor, at least ``least``, on the focal length without black borders.

    To 1e-4. Raises InputError where the lens folds the image.
    """
    low, high = least, least
    while not _sees(lens, high):
        low, high = high, high * 1.25
        if high > 8:
            raise InputError(
                "The distortion coefficients fold the image over itself; check their order "
                "(k1, k2, p1, p2, k3; of a fisheye k1, k2, k3, k4) and that they belong to "
                "this camera."
            )
    while high - low > 1e-4:
        middle = (low + high) / 2
        if _sees(lens, middle):
            high = middle
        else:
            low = middle
    return high


def _sees(lens: Camera, zoom: float) -> bool:
    """Whether the border of the zoomed pinhole lies in the image, inside any fold."""
    rays = _border_rays(zoomed(lens.pinhole, zoom))
    pixels = lens.pixels(rays)
    last = pixels.new_tensor([lens.width, lens.height]) - 0.5
    inside = (pixels >= -0.5) & (pixels <= last)
    return bool(inside.all() and lens.shows(rays).all())


def _border_rays(camera: Camera) -> Float[Tensor, "n 2"]:
    """Return x / z, y / z of the outermost pixels."""
    u = torch.arange(camera.width, dtype=torch.float64)
    v = torch.arange(camera.height, dtype=torch.float64)
    sides = [torch.stack([u, torch.full_like(u, y)], -1) for y in (0, camera.height - 1)]
    ends = [torch.stack([torch.full_like(v, x), v], -1) for x in (0, camera.width - 1)]
    return camera.plane(torch.cat([*sides, *ends]))
