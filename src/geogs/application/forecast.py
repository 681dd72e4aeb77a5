"""About how long the present stage of some work will still take."""

import time
from collections.abc import Callable

_FEW_MARKS = 8
"""Parts of a stage up to which its pace is that of all of them."""


class StageForecast:
    """The rest of a stage at its own pace; of what comes after it nothing is known."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._stage = ""
        self._marks: list[tuple[float, float]] = []
        """How much of the stage was done, and when."""

    def left(self, stage: str, done: float | None) -> float | None:
        """Seconds left of a stage of which a fraction is done; none where that cannot be said.

        The pace is that of the later half of what is done: first parts often differ.
        """
        now = self._clock()
        if stage != self._stage:
            self._stage, self._marks = stage, []
        if done is None:
            return None
        self._marks.append((done, now))
        begun, start = self._marks[len(self._marks) // 2 if len(self._marks) > _FEW_MARKS else 0]
        return (now - start) * (1 - done) / (done - begun) if done > begun else None
