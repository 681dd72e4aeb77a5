"""A card: what a network's file wants and what its numbers mean, as a small YAML file."""

import importlib.resources
from dataclasses import dataclass, fields
from enum import Enum
from pathlib import Path
from typing import Any

from geogs.documents import LARGEST_SETTINGS, read_text, yaml_value
from geogs.errors import InputError
from geogs.priors.base import DepthKind


class Resize(Enum):
    """How an image is brought to a size that the network takes."""

    STRETCH = "stretch"
    """To exactly ``height`` x ``width``, whatever the aspect."""
    AT_LEAST = "at_least"
    """Aspect kept, both sides at least ``height`` and ``width``, then to the next multiple."""
    PAD = "pad"
    """Aspect kept, as large as fits into ``height`` x ``width``, the rest padded evenly."""
    MULTIPLE = "multiple"
    """As it is, padded evenly to the next multiple."""


@dataclass(frozen=True)
class PriorCard:
    """What goes into a network and what comes out. Images are RGB unless ``channels`` says BGR."""

    name: str
    source: str
    """Where the network is described, and where its file comes from."""
    licence: str
    runtime: str = "onnx"
    """onnx, or omnidata for the published checkpoints of that network."""
    note: str = ""
    """What a user should know; what could not be confirmed."""
    resize: Resize = Resize.STRETCH
    height: int = 0
    width: int = 0
    multiple: int = 1
    interpolation: str = "linear"
    """linear, cubic or area, of the image on its way in."""
    channels: str = "rgb"
    full_scale: float = 1.0
    """Value of white before ``mean`` and ``std``: 1 or 255."""
    mean: tuple[float, ...] = (0.0, 0.0, 0.0)
    std: tuple[float, ...] = (1.0, 1.0, 1.0)
    padding: tuple[float, ...] = (0.0, 0.0, 0.0)
    """Colour of what is padded, on the full scale."""
    image_input: str = ""
    """Name of the input for the image; none takes the only one."""
    camera_input: str = ""
    """Name of the input for the 3 x 3 camera matrix in pixels of the network's image, if any."""
    depth_output: str = ""
    """Name of the output with depth or inverse depth; none takes the only one."""
    depth_kind: DepthKind | None = None
    """What it means; none where the network gives no depth."""
    depth_range: tuple[float, ...] = ()
    """Least and largest value that means anything; others are clamped."""
    normal_output: str = ""
    """Name of the output with normals, three channels or more; none takes the only one."""
    normal_axes: str = ""
    """Signs that bring them to x right, y down, z forward and facing the camera: ``+x+y+z`` where
    they are so already, ``+x-y-z`` from y up and z backward. None where there are no normals."""
    normal_scale: float = 1.0
    normal_offset: float = 0.0
    """A component is ``normal_scale`` times the number plus this."""

    def __post_init__(self) -> None:
        sized = self.resize in (Resize.STRETCH, Resize.AT_LEAST, Resize.PAD)
        problems = {
            f"runtime {self.runtime} is neither onnx nor omnidata": self.runtime
            not in ("onnx", "omnidata"),
            "height and width must be positive": sized and min(self.height, self.width) < 1,
            "multiple must be positive": self.multiple < 1,
            f"interpolation {self.interpolation} is not linear, cubic or area": self.interpolation
            not in ("linear", "cubic", "area"),
            f"channels {self.channels} is neither rgb nor bgr": self.channels not in ("rgb", "bgr"),
            "mean, std and padding must have three numbers": any(
                len(v) != 3 for v in (self.mean, self.std, self.padding)
            ),
            "std must be positive": min(self.std, default=1.0) <= 0,
            "depth_range must be empty or two numbers": len(self.depth_range) not in (0, 2),
            "it gives neither depth (depth_kind) nor normals (normal_axes)": self.depth_kind is None
            and not self.normal_axes,
        }
        for problem, is_there in problems.items():
            if is_there:
                raise InputError(f"The card {self.name} is wrong: {problem}.")
        self.axes  # noqa: B018  # raises where the axes are wrong

    @property
    def axes(self) -> tuple[float, float, float] | None:
        """``normal_axes`` as three factors; None without."""
        if not self.normal_axes:
            return None
        text = self.normal_axes.replace(" ", "")
        signs = {"+": 1.0, "-": -1.0}
        if len(text) != 6 or text[1::2] != "xyz" or not set(text[::2]) <= set(signs):
            raise InputError(
                f"The card {self.name} is wrong: normal_axes {text[:40]!r} is not like +x-y-z."
            )
        return (signs[text[0]], signs[text[2]], signs[text[4]])


def card_names() -> list[str]:
    """Cards that come with geogs."""
    folder = importlib.resources.files("geogs.priors") / "cards"
    return sorted(f.name.removesuffix(".yaml") for f in folder.iterdir() if f.name[-5:] == ".yaml")


def load_card(name: str) -> PriorCard:
    """A card by the name of one that comes with geogs, or a YAML file.

    Raises InputError if there is none or if it does not say what it must.
    """
    shipped = importlib.resources.files("geogs.priors") / "cards" / f"{name}.yaml"
    path = Path(name)
    if "/" not in name and shipped.is_file():
        text = shipped.read_text("utf-8")
    elif path.is_file():
        text = read_text(path, LARGEST_SETTINGS)
    else:
        known = ", ".join(card_names())
        raise InputError(f"There is no card {name}: give a YAML file, or one of {known}.")
    content = yaml_value(text, f"The card {name}")
    if not isinstance(content, dict):
        raise InputError(f"The card {name} must be a list of settings.")
    return _from_settings(name, content)


def _from_settings(name: str, content: dict[Any, Any]) -> PriorCard:
    known = {f.name for f in fields(PriorCard)}
    unknown = [str(key)[:40] for key in content if key not in known]
    if unknown:
        raise InputError(f"The card {name} has a setting {unknown[0]!r}, which does not exist.")
    kinds = {f.name: f.type for f in fields(PriorCard)}
    try:
        return PriorCard(**{k: _value(k, kinds[k], v) for k, v in content.items()})
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"The card {name} is wrong: {error}.") from None


def _value(name: str, kind: Any, value: Any) -> Any:
    """A setting as its field wants it; raises ValueError for what it cannot be."""
    if kind is Resize:
        return _one_of(Resize, name, value)
    if kind == DepthKind | None:
        return None if value is None else _one_of(DepthKind, name, value)
    if kind is int and type(value) is int:
        return value
    if kind is str and isinstance(value, str):
        return value
    numbers = value if isinstance(value, list) else [value]
    if kind in (int, str) or not all(type(v) in (int, float) for v in numbers):
        raise ValueError(f"{name} cannot be {str(value)[:40]!r}")
    if not all(abs(v) < 1e30 for v in numbers):  # NaN is not, either
        raise ValueError(f"{name} must be finite")
    return float(value) if kind is float else tuple(float(v) for v in numbers)


def _one_of(kind: type[Enum], name: str, value: Any) -> Enum:
    if value not in {member.value for member in kind}:
        known = ", ".join(str(member.value) for member in kind)
        raise ValueError(f"{name} is {str(value)[:40]!r}, not one of {known}")
    return kind(value)
