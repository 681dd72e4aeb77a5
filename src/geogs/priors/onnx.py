"""A prior from an ONNX file and a card that describes the network's input and output.

Images are brought to the size that the network takes, and its maps back to that of the image.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from geogs.errors import InputError
from geogs.extras import install_command
from geogs.geometry.camera import Camera
from geogs.guard.documents import in_short, require_file
from geogs.priors.card import PriorCard
from geogs.priors.monocular_prior import DepthKind, PriorMaps
from geogs.threads import worker_count

_INTERPOLATION = {"linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC, "area": cv2.INTER_AREA}


class OnnxPrior:
    """Runs an ONNX network on single images; on a GPU where onnxruntime has been built for it."""

    def __init__(
        self, model: Path, card: PriorCard, camera: Camera, device: torch.device | str = "cpu"
    ) -> None:
        """``camera`` is that of the images.

        Raises InputError if onnxruntime is missing or the file does not fit the card.
        """
        self.card = card
        self.camera = camera
        self._session = _open(model, torch.device(device))
        inputs = [i.name for i in self._session.get_inputs()]
        outputs = [o.name for o in self._session.get_outputs()]
        self._image = card.image_input or _only(inputs, card.camera_input, "image_input", model)
        self._depth = self._normal = ""
        if card.depth_kind is not None:
            other = card.normal_output
            self._depth = card.depth_output or _only(outputs, other, "depth_output", model)
        if card.axes is not None:
            other = card.depth_output
            self._normal = card.normal_output or _only(outputs, other, "normal_output", model)
        _require(inputs, [self._image, card.camera_input], "input", model)
        _require(outputs, [self._depth, self._normal], "output", model)

    def predict(self, image: UInt8[np.ndarray, "h w 3"]) -> PriorMaps:
        """Depth and normals, as far as the card has them, at the size of the image; on the CPU."""
        fitted = fit_image(image, self.card)
        feed = {self._image: fitted.pixels}
        if self.card.camera_input:
            feed[self.card.camera_input] = fitted.camera(self.camera)
        names = [n for n in (self._depth, self._normal) if n]
        try:
            found = dict(zip(names, self._session.run(names, feed), strict=True))
        except Exception as error:  # onnxruntime raises classes of its own
            raise InputError(
                f"The monocular network {self.card.name} fails{_said(error)}."
            ) from error
        return prior_maps(found.get(self._depth), found.get(self._normal), fitted, self.card)


@dataclass(frozen=True)
class FittedImage:
    """An image as a network takes it."""

    pixels: Float[np.ndarray, "1 3 nh nw"]
    size: tuple[int, int]
    """Height and width of the image itself."""
    inner: tuple[int, int]
    """Height and width that the image has within the network's, without padding."""
    top: int
    left: int
    """Padding above and to the left of it."""

    def camera(self, camera: Camera) -> Float[np.ndarray, "1 3 3"]:
        """The camera matrix in pixels of the network's image; pixel centres at integers."""
        inner = camera.resized(self.inner[1], self.inner[0])
        K = inner.matrix().numpy().astype(np.float32)
        K[:2, 2] += self.left, self.top
        return K[None]

    def back(self, values: Float[np.ndarray, "nh nw *c"]) -> Float[np.ndarray, "h w *c"]:
        """Bring a map of the network to the size of the image, without the padding.

        A map of another resolution than the network's image is first brought to that.
        """
        size = self.pixels.shape[2:]
        values = cv2.resize(values, size[::-1], interpolation=cv2.INTER_LINEAR)
        inner = values[self.top : self.top + self.inner[0], self.left : self.left + self.inner[1]]
        return cv2.resize(inner, self.size[::-1], interpolation=cv2.INTER_LINEAR)


def fit_image(image: UInt8[np.ndarray, "h w 3"], card: PriorCard) -> FittedImage:
    """Resize, pad, order and normalise an RGB image as a card prescribes."""
    height, width = image.shape[:2]
    inner, outer = _sizes(height, width, card)
    scaled: np.ndarray = image.astype(np.float32) * np.float32(card.full_scale / 255)
    scaled = cv2.resize(scaled, inner[::-1], interpolation=_INTERPOLATION[card.interpolation])
    top = (outer[0] - inner[0]) // 2
    left = (outer[1] - inner[1]) // 2
    bottom = outer[0] - inner[0] - top
    right = outer[1] - inner[1] - left
    border = cv2.BORDER_CONSTANT
    scaled = cv2.copyMakeBorder(scaled, top, bottom, left, right, border, value=card.padding)
    normal = (scaled - np.array(card.mean, np.float32)) / np.array(card.std, np.float32)
    if card.channels == "bgr":
        normal = normal[..., ::-1]
    pixels = np.ascontiguousarray(normal.transpose(2, 0, 1)[None], np.float32)
    return FittedImage(pixels, (height, width), inner, top, left)


def prior_maps(
    depth: np.ndarray | None, normal: np.ndarray | None, fitted: FittedImage, card: PriorCard
) -> PriorMaps:
    """A network's outputs as depth and normals at the size of the image, on the CPU.

    Raises InputError if one has a wrong shape.
    """
    return PriorMaps(
        card.kind or DepthKind.SCALE_FREE,
        None if depth is None else torch.from_numpy(_depth_map(depth, fitted, card)),
        None if normal is None else torch.from_numpy(_normal_map(normal, fitted, card)),
    )


def _depth_map(
    output: np.ndarray, fitted: FittedImage, card: PriorCard
) -> Float[np.ndarray, "h w"]:
    """A network's depth, (1, 1, h, w) or fewer leading ones, at the size of the image."""
    values = np.asarray(output, np.float32)
    if values.ndim < 2 or values.size != values.shape[-1] * values.shape[-2]:
        raise InputError(f"Depth of {card.name} has shape {values.shape}, not (1, 1, h, w).")
    values = values.reshape(values.shape[-2:])
    if card.depth_range:
        values = values.clip(card.depth_range[0], card.depth_range[1])
    return fitted.back(values)


def _normal_map(
    output: np.ndarray, fitted: FittedImage, card: PriorCard
) -> Float[np.ndarray, "h w 3"]:
    """A network's normals, (1, 3 or more, h, w), in our axes and of unit length; zero, which is
    unknown, if shorter than 0.2."""
    values = np.asarray(output, np.float32)
    if values.ndim != 4 or values.shape[0] != 1 or values.shape[1] < 3:
        raise InputError(f"Normals of {card.name} have shape {values.shape}, not (1, 3, h, w).")
    scaled = card.normal_scale * values[0, :3] + card.normal_offset
    scaled = scaled.transpose(1, 2, 0) * np.array(card.axes, np.float32)
    normal = fitted.back(np.ascontiguousarray(scaled, np.float32))
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.where(length < 0.2, 0, normal / np.maximum(length, 1e-6)).astype(np.float32)


def _sizes(height: int, width: int, card: PriorCard) -> tuple[tuple[int, int], tuple[int, int]]:
    """Height and width of the image within the network's, and those of the latter."""
    if card.resize == "stretch":
        inner = outer = (card.height, card.width)
    elif card.resize == "at_least":
        scale = max(card.height / height, card.width / width)
        inner = outer = (
            _multiple_at_least(height * scale, card.height, card.multiple),
            _multiple_at_least(width * scale, card.width, card.multiple),
        )
    elif card.resize == "pad":
        scale = min(card.height / height, card.width / width)
        inner = (max(int(height * scale), 1), max(int(width * scale), 1))
        outer = (card.height, card.width)
    else:
        inner = (height, width)
        outer = (
            -(-height // card.multiple) * card.multiple,
            -(-width // card.multiple) * card.multiple,
        )
    return inner, outer


def _multiple_at_least(size: float, least: int, multiple: int) -> int:
    """The multiple nearest to a size, the next one where that is too small."""
    nearest = round(size / multiple) * multiple
    return nearest if nearest >= least else -(-least // multiple) * multiple


def _open(model: Path, device: torch.device) -> Any:
    try:
        import onnxruntime
    except ImportError as error:
        command = install_command("priors")
        raise InputError(f"Networks in ONNX files need onnxruntime: {command}") from error
    if not model.is_file():
        raise InputError(f"There is no file {model} with a monocular network.")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = worker_count()
    options.log_severity_level = 3
    wanted = ["CUDAExecutionProvider"] * (device.type == "cuda") + ["CPUExecutionProvider"]
    providers = [p for p in wanted if p in onnxruntime.get_available_providers()]
    try:
        return onnxruntime.InferenceSession(
            str(require_file(model)), options, providers, enable_fallback=0
        )
    except Exception as error:  # onnxruntime raises classes of its own
        raise InputError(f"{model} is no ONNX network that can be used{_said(error)}.") from error


def _said(error: Exception) -> str:
    """The reason in brackets; empty if there is none."""
    words = in_short(str(error).encode("ascii", "replace").decode()).strip(" .")
    return f" ({words})" if words else ""


def _only(names: Sequence[str], other: str, setting: str, model: Path) -> str:
    """The only name besides the ``other`` one; raises InputError where there is none or more."""
    free = [name for name in names if name != other]
    if len(free) == 1:
        return free[0]
    listed = ", ".join(free) or "none"
    raise InputError(f"{model} leaves open which is the {setting} of its card: {listed}.")


def _require(there: Sequence[str], names: Sequence[str], what: str, model: Path) -> None:
    missing = [n for n in names if n and n not in there]
    if missing:
        raise InputError(
            f"{model} has no {what} {missing[0]}, which its card names; it has {', '.join(there)}."
        )
