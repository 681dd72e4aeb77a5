"""Times of images in a folder: those in their names, or of a list beside them."""

import datetime
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from geogs.errors import InputError
from geogs.guard.documents import read_text
from geogs.io.pose_files import FRAMES_PER_SECOND
from geogs.io.sources.account import Account
from geogs.io.sources.reader import median_rate

_PREFIX = r"(?:[a-z][a-z_ -]*(?:\d[-_ ])?)?"
_FRACTION = r"[._-]?(\d{3}|\d{6}|\d{7}|\d{9})"
"""Milli-, micro- or nanoseconds, or 100 of these."""
_EPOCH = re.compile(rf"{_PREFIX}(1\d{{9}})(?:{_FRACTION})?", re.IGNORECASE)
_DATE = re.compile(
    rf"{_PREFIX}(20\d\d)-?(\d\d)-?(\d\d)[-_ T]?(\d\d)[-:_.]?(\d\d)[-:_.]?(\d\d){_FRACTION}Z?",
    re.IGNORECASE,
)
_EARLIEST = 1_200_000_000
"""Earliest whole second of the epoch that a number of ten digits can be: 2008."""
_LIST = re.compile(r"(.*[-_.])?(time|stamp|timestamp)s?([-_.].*)?\.(txt|csv|tsv)", re.IGNORECASE)
"""Names of lists of times."""
_UNITS = ((1e1, 1.0), (1e4, 1e-3), (1e7, 1e-6), (1e10, 1e-9))
"""Median steps below which times count as of a unit, in seconds: at 0.1 to 100 images a second."""
LONG_GAP = 1.0
"""Seconds; a gap that is longer, and ten times the usual one, is said."""


def time_in(stem: str) -> float | None:
    """Time in seconds that a file name holds; none for an ordinary name or number.

    It is seconds with a fraction (TUM), a time of the epoch down to milli-, micro- or nanoseconds
    (EuRoC), alone or after a word, or a date and time with a fraction of a second, in UTC.
    """
    if re.fullmatch(r"\d+\.\d+", stem):
        return float(stem)
    if match := _EPOCH.fullmatch(stem):
        seconds, fraction = match.groups(default="")
        is_time = bool(fraction) or int(seconds) >= _EARLIEST
        return int(seconds + fraction) * 10.0 ** -len(fraction) if is_time else None
    if match := _DATE.fullmatch(stem):
        *whole, fraction = match.groups()
        try:
            date = datetime.datetime.strptime("".join((*whole, "Z")), "%Y%m%d%H%M%S%z")
        except ValueError:
            return None
        return date.timestamp() + int(fraction) * 10.0 ** -len(fraction)
    return None


def listed_times(
    paths: Sequence[Path], folders: Sequence[Path]
) -> tuple[Float64[np.ndarray, "n"], Account]:
    """Times of images in seconds by a list beside them, else 30 a second, and a sentence on it.

    Args:
        paths: the images in natural order.
        folders: where the list may lie.
    """
    left = []
    for listing in _lists(folders):
        try:
            times = _read(listing, paths)
        except ValueError as error:
            left.append(f"{listing.name} as times of the images: {error}")
            continue
        return times, Account((f"times: those of {listing.name}, {spacing(times)}",), tuple(left))
    missing = _missing(paths)
    though = f", though {missing} of the numbers in their names are missing" if missing else ""
    assumed = f"times: {FRAMES_PER_SECOND:g} images a second assumed{though}"
    return np.arange(len(paths)) / FRAMES_PER_SECOND, Account((assumed,), tuple(left))


def spacing(times: Float64[np.ndarray, "n"]) -> str:
    """How far times are apart, in words."""
    steps = np.diff(np.sort(times))
    if not len(steps):
        return "one image"
    rate = f"{median_rate(steps):.3g} images a second"
    is_gap = steps.max() > max(LONG_GAP, 10 * np.median(steps))
    return f"{rate}, with a gap of {steps.max():.1f} s" if is_gap else rate


def _missing(paths: Sequence[Path]) -> int:
    """How many numbers are missing in the names of images, by the step that most have."""
    found = [re.findall(r"\d+", path.stem) for path in paths]
    numbers = [int(digits[-1]) for digits in found if digits and len(digits[-1]) < 10]
    steps = np.diff(np.unique(numbers))
    if len(steps) < 3 or len(steps) + 1 < len(paths):
        return 0
    return int((steps // max(int(np.median(steps)), 1) - 1).clip(min=0).sum())


def _lists(folders: Sequence[Path]) -> Iterator[Path]:
    for folder in dict.fromkeys(folders):
        yield from (p for p in sorted(folder.glob("*")) if _LIST.fullmatch(p.name) and p.is_file())


def _read(listing: Path, paths: Sequence[Path]) -> Float64[np.ndarray, "n"]:
    """Times of the images in seconds. Raises ValueError with the reason why it has none."""
    try:
        lines = read_text(listing).splitlines()
    except InputError:
        raise ValueError("it is no text that can be read") from None
    table = [_words(line) for line in lines if line.strip("#,; \t")]
    rows = [row for row in table if not row[0].startswith("#") and any(map(_is_number, row))]
    if not rows or len({len(row) for row in rows}) > 1:
        raise ValueError("its rows are no table")
    columns = [*zip(*rows, strict=True)]
    named = next((row for row in table if row not in rows and len(row) == len(columns)), [])
    order = _order(columns, paths)
    numbers = {
        k: np.array(c, float)[order] for k, c in enumerate(columns) if all(map(_is_number, c))
    }
    rising = {k: times for k, times in numbers.items() if (np.diff(times) > 0).all()}
    stamps = [k for k in rising if named and re.search("time|stamp", named[k], re.IGNORECASE)]
    counts = [k for k, times in rising.items() if (np.diff(times) == 1).all()]
    chosen = stamps or [k for k in rising if k not in counts]
    if not chosen:
        raise ValueError("no column of it rises like times")
    times = rising[chosen[0]]
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    unit = next((unit for limit, unit in _UNITS if step < limit), None)
    if unit is None:
        raise ValueError("the unit of its times is not known")
    return times * unit


def _words(line: str) -> list[str]:
    """Words of a row: between commas, semicolons or tabs, else between spaces."""
    line = re.sub(r"^#\s*", "#", line.strip())
    words = re.split(r"[,;\t]", line)
    return [word.strip() for word in words] if len(words) > 1 else line.split()


def _order(columns: Sequence[Sequence[str]], paths: Sequence[Path]) -> list[int]:
    """Row of each image: by its name where rows hold names, else in order. Raises ValueError where
    some have none."""
    for column in columns:
        names = [w if _is_number(w) else Path(w.replace("\\", "/")).stem for w in column]
        row_of = {name: k for k, name in enumerate(names)}
        if all(path.stem in row_of for path in paths):
            return [row_of[path.stem] for path in paths]
    count = len(columns[0])
    if count != len(paths):
        raise ValueError(f"it has {count} rows for {len(paths)} images")
    if any(re.search(r"\.[a-z]{3,4}$", column[0], re.IGNORECASE) for column in columns):
        raise ValueError("it names other images")
    return list(range(count))


def _is_number(word: str) -> bool:
    """Whether a word is a finite number."""
    return re.fullmatch(r"[-+]?\d{0,30}\.?\d{1,30}(e[-+]?\d\d?)?", word, re.IGNORECASE) is not None
