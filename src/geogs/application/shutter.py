"""Before a run: how long the shutter takes, which nobody said, from the video itself."""

import math
from typing import TYPE_CHECKING

from geogs.application.interrupt import Stop
from geogs.application.progress import RunProgress
from geogs.io.sources.sniff import Stream
from geogs.shutter.shutter import Shutter

if TYPE_CHECKING:
    from geogs.shutter.readout import FoundReadout

_STAGE = "shutter"


def with_shutter_found(
    source: Stream, progress: RunProgress | None = None, stop: Stop | None = None
) -> Stream:
    """The source with the readout of its rolling shutter found, if nobody gave it.

    Where the video does not show one, or after a request to stop, the shutter counts as global, and
    the frames stay as they are.
    """
    progress, stop = progress or RunProgress(), stop or Stop()
    if not source.is_shutter_open:
        return source
    from geogs.shutter.readout import find_readout

    clips = source.clips()
    with stop:

        def report(fraction: float) -> None:
            progress.stage(_STAGE, fraction)
            stop.check()

        try:
            found = find_readout(clips, source.rolling_camera, report)
        except KeyboardInterrupt:
            if not stop.requested:
                raise
            progress.write(
                "The search for the shutter's readout is stopped; going on with a global shutter. "
                "Press Ctrl-C again to end."
            )
            return source
        finally:
            clips.close()
    if not found.is_believed:
        return source.with_shutter(Shutter(origin=_evidence(found)))
    progress.write(
        f"Rolling shutter: {1000 * found.readout:.1f} ms from the first to the last row "
        f"({_evidence(found)}); rows are rectified."
    )
    origin = f"found in the video: {_evidence(found)}"
    return source.with_shutter(Shutter(found.readout, origin, found.error))


def _evidence(found: "FoundReadout") -> str:
    """Why the readout is believed, or why a global shutter is."""
    if not math.isfinite(found.error):
        return "the video does not tell"
    best, error = 1000 * found.best, 1000 * found.error
    return f"{found.clips} clips say {best:.1f} ms, standard error {error:.1f} ms"
