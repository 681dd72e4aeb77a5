"""The camera in the adjustment of all keyframes: rows, lens, and what each frame has of its own."""

from geogs.loop.camera.found import FoundLenses
from geogs.loop.camera.frame_lenses import correct_frame_lenses
from geogs.loop.camera.lens import correct_lens
from geogs.loop.camera.rows import correct_rows, let_lenses_move
from geogs.loop.camera.straightening import BentImages, straighten
from geogs.loop.keyframe_matches import KeyframeMatches


def adjust_camera(matches: KeyframeMatches, ends: bool) -> None:
    """Match all keyframes, and correct the matches for what they say of the camera.

    Where that ``ends`` the tracking and a lens was found, everything is straightened by it, matched
    and adjusted once more, and what matches say of the lens then is taken off them and the images;
    so it is found in any case where nobody said the focal length
    (``KeyframeTable.focal_deviation``), first by matches at half the resolution.
    """
    keyframes, fine = matches.keyframes, matches.tracker.config.fine_adjustment
    # What tells of the lens is matched anew on straight images: half the resolution is enough.
    is_open = ends and keyframes.table.focal_deviation > 0
    matches.measure(fine and not is_open)
    readout = correct_rows(matches, finds_readout=fine)
    lens = correct_lens(matches, ends, readout=readout)
    if not ends:
        return
    varying = correct_frame_lenses(matches)
    found = lens.followed_by(keyframes.camera, varying)
    images = BentImages.of(keyframes)
    if found:
        straighten(matches.tracker, found.views(keyframes.camera), images)
    if found or (is_open and fine):
        matches.measure(fine)
        let_lenses_move(matches, found.own)
        correct_rows(matches, finds_readout=False)
    if found:
        images.straighten(_once_more(matches, found, lens, varying).views(keyframes.camera))


def _once_more(
    matches: KeyframeMatches, found: FoundLenses, lens: FoundLenses, varying: FoundLenses
) -> FoundLenses:
    """What was found, with what matches on images that are straight by it say of the same."""
    camera = matches.keyframes.camera
    more = correct_frame_lenses(matches, before=found) if varying else FoundLenses()
    found = found.followed_by(camera, more)
    if lens:
        found = found.followed_by(camera, correct_lens(matches, ends=True, before=found.lens))
    more.shift(matches.log, matches.keyframes)
    return found
