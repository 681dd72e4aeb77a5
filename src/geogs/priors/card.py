"""Cards: small YAML files on the input and output of a network's file."""

import re
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from geogs.config.setting import Count, CountOrZero, Kind, Positive, Range, kinds
from geogs.errors import InputError
from geogs.guard.documents import read_yaml
from geogs.priors.monocular_prior import DepthKind

_CARDS = Path(__file__).parent / "cards"
_AXES = re.compile(r"([+-])x([+-])y([+-])z")

Number = Annotated[float, Range(-1e6, 1e6)]


@dataclass(frozen=True)
class PriorCard:
    """Input and output of a network. Images are RGB unless ``channels`` is BGR."""

    name: str
    source: str
    """Source of the network's description and of its file."""
    licence: str
    note: str = ""
    """Remarks for the user; facts that could not be confirmed."""
    resize: Literal["stretch", "at_least", "pad", "multiple"] = "stretch"
    """Method to bring an image to a size that the network takes. Stretched: to exactly ``height`` x
    ``width``, whatever the aspect. At least: aspect kept, both sides at least these, then to the
    next multiple. Padded: aspect kept, as large as fits into these, the rest padded evenly.
    Multiple: as it is, padded evenly to the next multiple."""
    height: CountOrZero = 0
    width: CountOrZero = 0
    multiple: Count = 1
    interpolation: Literal["linear", "cubic", "area"] = "linear"
    """Interpolation by which the image is resized."""
    channels: Literal["rgb", "bgr"] = "rgb"
    full_scale: Number = 1.0
    """Value of white before ``mean`` and ``std``: 1 or 255."""
    mean: tuple[Number, ...] = (0.0, 0.0, 0.0)
    std: tuple[Positive, ...] = (1.0, 1.0, 1.0)
    padding: tuple[Number, ...] = (0.0, 0.0, 0.0)
    """Colour of the padding, on the full scale."""
    image_input: str = ""
    """Name of the input for the image; none takes the only one."""
    camera_input: str = ""
    """Name of the input for the 3 x 3 camera matrix in pixels of the network's image, if any."""
    depth_output: str = ""
    """Name of the output with depth or inverse depth; none takes the only one."""
    depth_kind: Literal["metric", "scale_free", "affine_depth", "affine_inverse"] | None = None
    """Meaning of that output; None if the network gives no depth."""
    depth_range: tuple[Number, ...] = ()
    """Least and largest meaningful value; others are clamped."""
    normal_output: str = ""
    """Name of the output with normals, three channels or more; none takes the only one."""
    normal_axes: str = ""
    """Signs that bring them to x right, y down, z forward and facing the camera: ``+x+y+z`` where
    they are so already, ``+x-y-z`` from y up and z backward. None where there are no normals."""
    normal_scale: Number = 1.0
    normal_offset: Number = 0.0
    """A component is ``normal_scale`` times the number plus this."""

    def __post_init__(self) -> None:
        """Raises InputError for values that do not go together."""
        is_sized = self.resize == "multiple" or min(self.height, self.width) > 0
        axes = self.normal_axes.replace(" ", "")
        problems = {
            "height and width must be positive": not is_sized,
            "mean, std and padding must have three numbers": any(
                len(v) != 3 for v in (self.mean, self.std, self.padding)
            ),
            "depth_range must be empty or two numbers": len(self.depth_range) not in (0, 2),
            "it gives neither depth (depth_kind) nor normals (normal_axes)": self.depth_kind is None
            and not axes,
            f"normal_axes {axes[:40]!r} is not like +x-y-z": axes and not _AXES.fullmatch(axes),
        }
        for problem, is_there in problems.items():
            if is_there:
                raise InputError(f"{problem}.")

    @property
    def kind(self) -> DepthKind | None:
        """Meaning of the network's depth; None without depth."""
        return None if self.depth_kind is None else DepthKind(self.depth_kind)

    @property
    def axes(self) -> tuple[float, ...] | None:
        """``normal_axes`` as three factors; None without."""
        found = _AXES.fullmatch(self.normal_axes.replace(" ", ""))
        return None if found is None else tuple(float(f"{sign}1") for sign in found.groups())


def card_names() -> list[str]:
    """Cards that come with geogs."""
    return sorted(file.stem for file in _CARDS.glob("*.yaml"))


def load_card(name: str) -> PriorCard:
    """Load a card: one that comes with geogs, by its name, or a YAML file.

    Raises InputError if there is none, or if its settings are incomplete or wrong.
    """
    shipped = _CARDS / f"{name}.yaml"
    path = shipped if "/" not in name and shipped.is_file() else Path(name)
    if not path.is_file():
        known = ", ".join(card_names())
        raise InputError(f"There is no card {name}: give a YAML file, or one of {known}.")
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise InputError(f"The card {name} must be a list of settings.")
    return _from_settings(name, content)


def _from_settings(name: str, content: dict[Any, Any]) -> PriorCard:
    known = dict(kinds(PriorCard))
    settings = {}
    for key, value in content.items():
        if key not in known:
            raise InputError(
                f"The card {name} has a setting {str(key)[:40]!r}, which does not exist."
            )
        settings[key] = _value(known[key], value)
        if not known[key].allows(settings[key]):
            raise InputError(f"The card {name} is wrong: {key} must be {known[key]}.")
    required = (f.name for f in fields(PriorCard) if f.default is MISSING)
    if missing := [key for key in required if key not in settings]:
        raise InputError(f"The card {name} does not say {', '.join(missing)}.")
    try:
        return PriorCard(**settings)
    except InputError as error:
        raise InputError(f"The card {name} is wrong: {error}") from None


def _value(kind: Kind, value: Any) -> Any:
    """Convert a value of YAML to the type of its field, where possible."""
    if isinstance(value, list):
        return tuple(_value(kind, v) for v in value)
    is_whole = isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**53
    return float(value) if kind.base is float and is_whole else value
