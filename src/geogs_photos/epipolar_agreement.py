"""How far the poses of pictures explain the matches between them, whatever points these made."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

from geogs_photos.verified_matches import MAX_ERROR, verified_matches


def agreement(model: Any, database: Path, pictures: Collection[int]) -> dict[int, float]:
    """Part of each picture's verified matches with the other pictures that their poses explain.

    Those are matches that one motion of the camera explains, found without any pose; 0 where there
    are none.
    """
    kept, agreeing = dict.fromkeys(pictures, 0), dict.fromkeys(pictures, 0)
    for pair in verified_matches(model, database, pictures):
        off = pair.epipolar()
        for n in (pair.one, pair.other):
            kept[n] += len(off)
            agreeing[n] += int((off <= MAX_ERROR).sum())
    return {n: agreeing[n] / max(kept[n], 1) for n in pictures}
