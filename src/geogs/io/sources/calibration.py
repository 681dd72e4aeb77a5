"""A camera as the user or the data set describes it: intrinsics, distortion, and their origin."""

import math
from dataclasses import dataclass, field, replace

from geogs.camera.distortion import LensModel
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.sources.account import Account
from geogs.types import FoundLens

_LEAST_FOCAL, _MOST_FOCAL = 0.1, 100.0
"""Limits of focal length / longer image side: fields of view from 157 down to 0.6 degrees."""
_LARGEST_DISTORTION = 1e5
_ORDERS: dict[LensModel, tuple[tuple[int, ...], str]] = {
    "polynomial": ((0, 4, 5, 8), "k1, k2, p1, p2[, k3[, k4, k5, k6]]"),
    "fisheye": ((0, 4), "k1, k2, k3, k4 of a fisheye"),
}
"""Numbers of coefficients of a lens, and their order."""
GUESS = 0.35
"""Relative standard deviation of a focal length that is only assumed: hand-held cameras have
fields of view of 40 to 100 degrees."""
_SQUARE = 1e-3
"""Largest relative difference of fx and fy that counts as square pixels."""
_LONGEST_EDGE = 1 << 20
"""Longest image side in pixels."""


@dataclass(frozen=True)
class FocalRefinement:
    """Outcome of a self-calibration: focal length, and the distortion with it."""

    deviation: float | None = None
    """Standard deviation of fx in pixels of the source's images; none where there is a failure."""
    deviations: tuple[float, float] | None = None
    """Standard deviations of k1 and k2; none where they were not estimated."""
    keyframes: int = 0
    frames: int = 0
    """Number of frames examined."""
    failure: str | None = None
    """Why it failed."""
    is_explained: bool = True
    """Whether some camera explains the motion in the first views; if none does, moving objects may
    also dominate later estimates from all matches."""


@dataclass(frozen=True)
class Calibration:
    """Intrinsics in pixels (pixel centres at integers) with OpenCV distortion coefficients."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    """k1, k2, p1, p2(, k3(, k4, k5, k6)), empty for a pinhole; k1, k2, k3, k4 of a fisheye."""
    width: int | None = None
    """Image size the numbers hold for; none where it is not given."""
    height: int | None = None
    origin: str = "given"
    """Origin of the numbers, for the log and ``intrinsics.json``."""
    is_guess: bool = False
    """Whether the focal length is only assumed."""
    is_nominal: bool = False
    """Whether the focal length is the maker's nominal one, good to a few percent."""
    refinement: FocalRefinement | None = None
    """Outcome of a self-calibration, if there was one."""
    lens: LensModel = "polynomial"
    """Model of the coefficients."""
    account: Account = field(default_factory=Account, compare=False)
    """Findings in its file beside the numbers."""

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        count = len(self.distortion)
        counts, order = _ORDERS[self.lens]
        is_lens = all(abs(number) <= _LARGEST_DISTORTION for number in self.distortion)
        is_size = all(n is None or 1 <= n <= _LONGEST_EDGE for n in (self.width, self.height))
        size = f"{self.width}x{self.height}"
        focal = f"{self.fx:g}, {self.fy:g}"
        for is_right, fault in (
            (all(map(math.isfinite, numbers)), "hold NaN or infinity; correct them"),
            (count in counts, f"have {count} distortion numbers; give {order}"),
            (is_lens, "have distortion numbers that no lens has; correct them"),
            (is_size, f"are for images of {size} pixels, which there are not; correct them"),
            (
                min(self.fx, self.fy) > 0,
                f"say focal length {focal}; it must be positive, in pixels",
            ),
        ):
            if not is_right:
                raise InputError(f"The intrinsics ({self.origin}) {fault}.")

    @property
    def is_distorted(self) -> bool:
        """Whether there is any distortion to remove."""
        return self.lens == "fisheye" or any(number != 0 for number in self.distortion)

    @property
    def is_unknown_lens(self) -> bool:
        """Whether the distortion was not given: it is unknown, or estimated from the video."""
        is_asked = self.refinement is not None and not self.is_distorted
        return self.is_guess or self.is_found_lens or is_asked

    @property
    def is_found_lens(self) -> bool:
        """Whether focal length and distortion were estimated from the video; a lens without
        distortion counts as estimated."""
        said = self.refinement
        if said is None or said.failure is not None:
            return False
        return said.deviations is not None or not self.is_distorted

    @property
    def focal_deviation(self) -> float:
        """Relative standard deviation of a focal length that was estimated from the video or
        guessed; 0 where it was given."""
        if self.is_guess:
            return GUESS
        said = self.refinement
        found = said.deviation if said is not None and self.is_found_lens else None
        return 0.0 if found is None else found / self.fx

    @property
    def sentence(self) -> str:
        """The focal length, the lens and their origin, for the account of the input."""
        focal = f"fx {self.fx:.1f}"
        if abs(self.fx / self.fy - 1) > _SQUARE:
            focal += f", fy {self.fy:.1f}"
        lens = "fisheye" if self.lens == "fisheye" else "with distortion"
        kind = f", {lens}" if self.is_distorted else ""
        certainty = "assumed: " if self.is_guess else ""
        return f"camera: {focal} pixels{kind} ({certainty}{self.origin})"

    @staticmethod
    def of(camera: Camera) -> "Calibration":
        """Return the calibration of images of a camera."""
        is_fisheye = camera.is_fisheye
        terms = (camera.k1, camera.k2, camera.k3, camera.k4) if is_fisheye else camera.distortion
        if not is_fisheye:
            terms = terms[: next(n for n in (0, 4, 5, 8) if not any(terms[n:]))]
        return Calibration(
            camera.fx,
            camera.fy,
            camera.cx,
            camera.cy,
            terms,
            camera.width,
            camera.height,
            lens="fisheye" if is_fisheye else "polynomial",
        )

    def camera(self) -> Camera:
        """The camera of its images, with the distortion. The size must be known."""
        is_fisheye = self.lens == "fisheye"
        order = "k1 k2 k3 k4" if is_fisheye else "k1 k2 p1 p2 k3 k4 k5 k6"
        rest = dict(zip(order.split(), self.distortion, strict=False))
        width, height = self._size()
        return Camera(
            self.fx, self.fy, self.cx, self.cy, width, height, is_fisheye=is_fisheye, **rest
        )

    @property
    def numbers(self) -> str:
        """Intrinsics as the command line takes them."""
        values = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        name = ["fisheye"] if self.lens == "fisheye" else []
        return ",".join(name + [f"{value:.6g}" for value in values])

    def with_lens(self, found: FoundLens) -> "Calibration":
        """Return the calibration with the change that was found of its lens. The size must be
        known."""
        change = math.log(found.focal), found.k1, found.k2, found.right, found.down
        camera = self.camera().moved(*change)
        distortion = Calibration.of(camera).distortion
        origin = f"{self.origin}; distortion refined: k1 {found.k1:.4f}, k2 {found.k2:.4f}"
        if found.is_off_centre:
            off = camera.cx - self.cx, camera.cy - self.cy
            origin = f"{origin}, principal point moved by {off[0]:.1f}, {off[1]:.1f} pixels"
        bent = replace(self, cx=camera.cx, cy=camera.cy, distortion=distortion, origin=origin)
        if found.focal == 1:
            return bent
        own = found.deviation_k1, found.deviation_k2
        said = self.refinement or FocalRefinement()
        is_explained = said.is_explained or found.varies  # no constant camera does
        said = replace(said, deviations=own, failure=None, is_explained=is_explained)
        return replace(
            bent,
            fx=camera.fx,
            fy=camera.fy,
            is_guess=False,
            is_nominal=False,
            origin=f"{origin}, fx times {found.focal:.4f}",
            refinement=replace(said, deviation=found.deviation_focal * camera.fx),
        )

    def _size(self) -> tuple[int, int]:
        if self.width is None or self.height is None:
            raise AssertionError("fit() the calibration to the images first")
        return self.width, self.height

    def fit(self, width: int, height: int, quarter_turns: int = 0) -> "Calibration":
        """The calibration for images of ``width x height`` pixels.

        Args:
            width: width of the images as shown, in pixels.
            height: their height.
            quarter_turns: clockwise quarter turns between the stored and the shown images. A
                calibration made for the stored ones is rotated too: recognised by its size, or,
                where it has none, by its principal point.

        Raises:
            InputError: the calibration is for another shape of image.
        """
        stored = (height, width) if quarter_turns % 2 else (width, height)
        if self.width is None or self.height is None:
            shown_offset = math.hypot(self.cx - width / 2, self.cy - height / 2)
            stored_offset = math.hypot(self.cx - stored[0] / 2, self.cy - stored[1] / 2)
            size = stored if stored_offset < shown_offset else (width, height)
            return replace(self, width=size[0], height=size[1]).fit(width, height, quarter_turns)
        if same_shape(self.width, self.height, width, height):
            return self._scaled(width, height)
        if same_shape(self.width, self.height, *stored):
            turned = self
            for _ in range(quarter_turns % 4):
                turned = turned._turned_clockwise()
            return turned._scaled(width, height)
        raise InputError(
            f"The intrinsics ({self.origin}) are for {self.width}x{self.height} images, but the "
            f"source has {width}x{height}; give those of this camera mode."
        )

    def _scaled(self, width: int, height: int) -> "Calibration":
        camera = self.camera().resized(width, height)
        if not (-0.5 <= camera.cx <= width - 0.5 and -0.5 <= camera.cy <= height - 0.5):
            raise InputError(
                f"The principal point ({self.origin}) {self.cx:g}, {self.cy:g} lies outside the "
                f"{self.width}x{self.height} image; are the intrinsics for another resolution?"
            )
        least = _LEAST_FOCAL * camera.long_edge
        most = _MOST_FOCAL * camera.long_edge
        squeeze = max(camera.fx / camera.fy, camera.fy / camera.fx)
        if not all(least <= focal <= most for focal in (camera.fx, camera.fy)) or squeeze > 4:
            raise InputError(
                f"The focal length ({self.origin}) is {camera.fx:g}, {camera.fy:g} pixels for "
                f"images of {camera.width}x{camera.height}; plausible are {least:g} to {most:g}, "
                "about the same in both directions."
            )
        scaled = replace(self, fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy)
        return replace(scaled, width=width, height=height)

    def _turned_clockwise(self) -> "Calibration":
        """Pixel (x, y) moves to (height - 1 - y, x); the tangential terms turn with the axes."""
        width, height = self._size()
        distortion = self.distortion
        if len(distortion) >= 4 and self.lens == "polynomial":
            k1, k2, p1, p2, *radial = distortion
            distortion = (k1, k2, p2, -p1, *radial)
        turned = replace(self, fx=self.fy, fy=self.fx, cx=height - 1 - self.cy, cy=self.cx)
        return replace(turned, width=height, height=width, distortion=distortion)


def same_shape(width: int, height: int, other_width: int, other_height: int) -> bool:
    """Whether one size is the other scaled, up to rounding to whole pixels."""
    scale = max(other_width, other_height) / max(width, height)
    slack = max(1.0, scale) + 0.005 * max(other_width, other_height)
    return abs(width * scale - other_width) <= slack and abs(height * scale - other_height) <= slack
