"""Unit of sensor depth: as given, as a file beside the images states, or as usual and plausible."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.guard.documents import LARGEST_SETTINGS, first_file, open_file, read_json
from geogs.io.sources.account import Account
from geogs.io.sources.depth_files import DepthFile, DepthUnit, RecordedDepth
from geogs.io.sources.reader import RecordingInfo

NEAREST = 0.4
"""Metres; at most a twentieth of what a usual depth sensor measures is nearer."""
CLOSE = 0.9
"""Metres; at least a twentieth of what it measures of a scene is farther."""
FAR = 5.0
"""Metres; at least a twentieth is nearer, on a street too."""
NO_DISTANCE = 0.25
"""Metres nearer than which no depth sensor measures nearly all."""
FAR_MEDIAN = 20.0
"""Metres beyond which a median is said to be unusual."""
OTHERS = (1000.0, 5000.0, 1.0)
"""Units per metre that are tried where another one is assumed and gives unusual depths."""
CLEAR = 1.2
"""Ratio of two scales from which they differ."""
ROUGH = 1.6
"""The same where the focal length is only assumed or nominal."""
LOOKED_AT = 8
"""Number of depth images whose distances are looked at."""
METRES = DepthUnit(1.0, "the recording's", True)
LEAST_VALUES = 20
"""Fewest different values that tell what they are multiples of."""
_MOST_FILES = 50
"""Largest number of files that are searched for a unit."""
_DESCRIBING = {".json", ".yaml", ".yml", ".txt", ".ini", ".cfg", ".toml"}
_KEY = re.compile(
    r"""(?:m_|png_)?depth_?(?:map_?)?(?:scal(?:e|ing)|factor|shift|units?)
    (?:_?scale)?(?:_?factor)?(?:_?per_?met(?:er|re))?["']?\s*[:=]\s*["']?([-+.\w]+)""",
    re.IGNORECASE | re.VERBOSE,
)
"""ORB-SLAM's DepthMapFactor, NICE-SLAM's png_depth_scale, ScanNet's m_depthShift and so on."""
_WORDS = {"mm": 1e3, "millimeter": 1e3, "cm": 100.0, "centimeter": 100.0, "m": 1.0, "meter": 1.0}


@dataclass(frozen=True)
class ChosenDepth:
    """The sensor depth that a source uses."""

    is_used: bool = False
    unit: DepthUnit = METRES
    """Unit of depth images, in place of the files' own."""
    found: str = ""
    """The depth, in words."""
    median: float = math.nan
    """Median distance in metres."""
    left: tuple[str, ...] = ()
    """Sentences on depth that is not used, each with the reason."""
    doubt: str = ""
    """Why the unit can hardly be right, as a clause, unless poses confirm it."""
    is_needed: bool = False
    """Whether the user asked for it."""

    @property
    def account(self) -> Account:
        """The depth that is used, or left and why."""
        if not self.is_used:
            return Account(left=self.left)
        median = f", median {self.median:.2g} m" if math.isfinite(self.median) else ""
        is_odd = self.median < NO_DISTANCE or self.median > FAR_MEDIAN
        odd = ", which is unusual for a sensor: is the unit right?" if is_odd else ""
        return Account((f"{self.found}, {self.unit}{median}{odd}",), self.left)

    def of(self, stored: RecordedDepth) -> RecordedDepth:
        """A stored depth in the chosen unit."""
        return replace(stored, unit=self.unit) if isinstance(stored, DepthFile) else stored

    def checked(self, ratio: float | None, is_open: bool, name: str) -> "ChosenDepth":
        """The same, in the usual unit that given poses confirm instead of an assumed one; left
        alone where that is doubted and there are no poses.

        Args:
            ratio: distances by the parallax of the poses, divided by these; none where unknown.
            is_open: whether the focal length of the camera is only assumed or nominal.
            name: of the recording, for messages.

        Raises:
            InputError: the scales of depth and poses differ, and no other unit explains it; or the
                unit is doubted, and the user asked for depth.
        """
        if ratio is None and self.doubt:
            if self.is_needed:
                raise InputError(f"{name}: {self.doubt}.")
            return ChosenDepth(left=(f"{self.found}: {self.doubt}", *self.left))
        if ratio is None or abs(np.log(ratio)) < np.log(ROUGH if is_open else CLEAR):
            return self
        unit = self.unit
        fits = (n for n in OTHERS if abs(np.log(unit.per_metre / n / ratio)) < np.log(CLEAR))
        other = next(fits, None)
        if other is None or unit.is_stated:
            fitting = f" (--depth-unit {other:g} would fit)" if other else ""
            raise InputError(
                f"{name}: by the poses, distances are {ratio:.3g} times those of the depth sensor"
                f"{fitting}; leave out --poses or --depth, or give both in metres."
            )
        by_poses = DepthUnit(other, f"by the poses; {unit} was assumed")
        return replace(self, unit=by_poses, median=self.median * unit.per_metre / other)


def chosen_depth(config: InputConfig, info: RecordingInfo) -> ChosenDepth:
    """The sensor depth that ``input.depth`` and ``input.depth_unit`` select.

    Raises:
        InputError: depth is asked for and not there, or a unit is given and nothing has use for it.
    """
    given = None if config.depth_unit == "auto" else DepthUnit(config.depth_unit, "as given", True)
    if given and config.depth == "none":
        raise InputError("A unit of depth is given, but no depth is used; add --depth sensor.")
    if not info.has_depth:
        return _without(config.depth, info)
    count = info.depths if info.length is None else f"{info.depths} of {info.length}"
    found = f"sensor depth beside {count} images"
    if config.depth == "none":
        return ChosenDepth(left=(f"{found}: --depth auto uses it",))
    files = [depth for depth in info.depth_sample if isinstance(depth, DepthFile)]
    if not files:
        if given:
            raise InputError(f"{info.name} has depth in metres; leave out --depth-unit.")
        return ChosenDepth(True, METRES, found)
    stated, left = _stated(files[0])
    unit = given or stated or files[0].unit
    distances = _distances(files, unit)
    doubt = "" if unit.is_stated else _doubt(distances, unit)
    median = float(np.median(distances)) if len(distances) else math.nan
    return ChosenDepth(True, unit, found, median, left, doubt, config.depth == "sensor")


def camera_scale(file: Path) -> DepthUnit | None:
    """Unit that ``cam_params.json`` states as the scale of its camera; none without one.

    Raises:
        InputError: the scale is no number above 0.
    """
    document = read_json(file)
    camera = document.get("camera") if isinstance(document, dict) else None
    if not isinstance(camera, dict) or "scale" not in camera:
        return None
    scale = camera["scale"]
    if type(scale) not in (int, float) or not 0 < scale < 1e9:
        raise InputError(f"{file}: the scale of the depths is no number above 0; correct it.")
    return DepthUnit(float(scale), file.name, True)


def _without(asked: str, info: RecordingInfo) -> ChosenDepth:
    """No depth. Raises InputError where it is asked for."""
    why = f": {info.depth_fault}" if info.depth_fault else ""
    if asked == "sensor":
        raise InputError(
            f"{info.name} has no depth of a sensor beside its images that can be read here"
            f"{why}; leave out --depth, or give that of the images."
        )
    if not why and asked == "none":
        return ChosenDepth()
    return ChosenDepth(left=(f"sensor depth{why or ': there is none beside the images'}",))


def _stated(file: DepthFile) -> tuple[DepthUnit | None, tuple[str, ...]]:
    """The unit that a file beside a depth image or one folder above states, where the format does
    not; and sentences on what states one that cannot be used."""
    if file.unit.is_stated:
        return None, ()
    folders = (file.path.parent.parent, file.path.parent)
    parameters = first_file(folder / "cam_params.json" for folder in folders)
    if parameters and (unit := camera_scale(parameters)):
        return unit, ()
    texts = [
        sorted(path for path in folder.glob("*") if path.suffix.lower() in _DESCRIBING)
        for folder in folders
    ]
    words = {(p.name, word) for f in texts for p in f[:_MOST_FILES] for word in _words_on_depth(p)}
    units = {per_metre: name for name, word in sorted(words) if (per_metre := _per_metre(word))}
    if len(units) == 1:
        ((per_metre, name),) = units.items()
        return DepthUnit(per_metre, name, True), ()
    if units:
        named = " and ".join(f"{per_metre:g} ({name})" for per_metre, name in units.items())
        return None, (f"units of depth per metre that differ: {named}",)
    unclear = [f"{word} in {name}" for name, word in sorted(words) if _is_number(word)]
    return None, tuple(f"unit of depth {one}: units a metre, or metres a unit?" for one in unclear)


def _words_on_depth(path: Path) -> list[str]:
    """Values in the beginning of a text whose keys tell a unit of depth; comments count in .txt."""
    try:
        with open_file(path) as stream:
            text = stream.read(LARGEST_SETTINGS).decode(errors="replace")
    except InputError:
        return []
    if path.suffix.lower() != ".txt":
        text = re.sub(r"(?m)^\s*#.*$", "", text)
    return _KEY.findall(text)


def _is_number(word: str) -> bool:
    try:
        return float(word) > 0
    except ValueError:
        return False


def _per_metre(word: str) -> float | None:
    """Units per metre by a value, which may be metres per unit; none where it is neither."""
    if not _is_number(word):
        return _WORDS.get(word.lower().replace("metre", "meter").rstrip("s"))
    number = float(word)
    if 10 <= number < 1e6:
        return number
    return round(1 / number, 6) if 1e-6 < number <= 0.02 else None


def _distances(files: Sequence[DepthFile], unit: DepthUnit) -> Float64[np.ndarray, "n"]:
    """Known distances of some depth images, metres."""
    places = np.unique(np.linspace(0, len(files) - 1, LOOKED_AT).astype(int))
    maps = [replace(files[k], unit=unit).metres() for k in places]
    known = [m[m > 0].astype(np.float64) for m in maps if m is not None]
    return np.concatenate([np.zeros(0), *known])


def _doubt(distances: Float64[np.ndarray, "n"], unit: DepthUnit) -> str:
    """Why an assumed unit can hardly be right, as a clause; empty where it can be.

    It is doubted where another one fits better, unless the values tell that they were converted
    to it from that one.
    """
    if not len(distances):
        return ""
    near, far = np.percentile(distances, (5, 95))
    if NEAREST <= near <= FAR and far >= CLOSE:
        return ""
    for other in OTHERS:
        factor = unit.per_metre / other
        is_usual = NEAREST / 2 <= near * factor <= FAR and far * factor >= CLOSE
        if is_usual and not _is_multiple(distances, unit, factor):
            return (
                f"its depths would be {near:.2g} to {far:.2g} m by the unit that is assumed, "
                f"{unit}, but {near * factor:.2g} to {far * factor:.2g} m by {DepthUnit(other)}; "
                f"give --depth-unit {other:g} or {unit.per_metre:g}"
            )
    if far >= NO_DISTANCE:
        return ""
    return (
        f"its depths would be {near:.2g} to {far:.2g} m by the unit that is assumed, {unit}, which "
        "no sensor measures; give its units a metre by --depth-unit"
    )


def _is_multiple(distances: Float64[np.ndarray, "n"], unit: DepthUnit, factor: float) -> bool:
    """Whether many stored values are nearly all multiples of a whole factor above 1."""
    if factor < 2 or factor != int(factor):
        return False
    stored = np.rint(distances * unit.per_metre)
    is_multiple = stored % factor == 0
    return bool(is_multiple.mean() > 0.99) and len(np.unique(stored[is_multiple])) >= LEAST_VALUES
