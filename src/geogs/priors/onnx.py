"""A prior from an ONNX file and a card that describes the network's input and output."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8

from geogs.documents import require_file
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.priors.card import PriorCard
from geogs.priors.fitting import fit_image, prior_maps
from geogs.priors.monocular_prior import PriorMaps
from geogs.threads import worker_count

MISSING = "Monocular networks in ONNX files need onnxruntime: pip install 'geogs[priors]'."


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
        named = [n for n in (card.image_input, card.camera_input) if n]
        free = [n for n in inputs if n not in named]
        self._image = card.image_input or _only(free, "image_input", model)
        outputs = [o.name for o in self._session.get_outputs()]
        named = [n for n in (card.depth_output, card.normal_output) if n]
        free = [n for n in outputs if n not in named]
        self._depth = self._normal = ""
        if card.depth_kind is not None:
            self._depth = card.depth_output or _only(free, "depth_output", model)
        if card.axes is not None:
            self._normal = card.normal_output or _only(free, "normal_output", model)
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


def _open(model: Path, device: torch.device) -> Any:
    try:
        import onnxruntime
    except ImportError as error:
        raise InputError(MISSING) from error
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
    """The reason in brackets, in letters that a terminal can show; empty if there is none."""
    lines = str(error).encode("ascii", "replace").decode().split("\n")
    words = "".join(c if c.isprintable() else "?" for c in lines[0])[:200].strip(" .")
    return f" ({words})" if words else ""


def _only(names: Sequence[str], setting: str, model: Path) -> str:
    if len(names) == 1:
        return names[0]
    listed = ", ".join(names) or "none"
    raise InputError(f"{model} leaves open which is the {setting} of its card: {listed}.")


def _require(there: Sequence[str], names: Sequence[str], what: str, model: Path) -> None:
    missing = [n for n in names if n and n not in there]
    if missing:
        raise InputError(
            f"{model} has no {what} {missing[0]}, which its card names; it has {', '.join(there)}."
        )
