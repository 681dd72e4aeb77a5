"""The camera in the global adjustment: rows, lens, and per-frame intrinsics."""

from geogs.loop.camera.found import straight_views
from geogs.loop.camera.frame_lenses import correct_frame_lenses
from geogs.loop.camera.lens import correct_lens
from geogs.loop.camera.rows import correct_rows, let_lenses_move
from geogs.loop.camera.straightening import straighten
from geogs.loop.keyframe_matches import KeyframeMatches


def adjust_camera(matches: KeyframeMatches, ends: bool) -> None:
    """Match all keyframes, and estimate the camera from the matches.

    Matches always belong to the images as tracked: an estimated camera becomes that of the grid.
    Where this ``ends`` the tracking and a correction was found, pairs that have moved are matched
    again, everything is adjusted once more, and images are straightened for the map. Where the
    focal length was not given (``KeyframeTable.focal_deviation``) the first matches are at half the
    resolution, and all are measured again.
    """
    table, fine = matches.keyframes.table, matches.tracker.config.fine_adjustment
    is_open = ends and table.focal_deviation > 0
    matches.measure(fine and not is_open)
    readout = correct_rows(matches, finds_readout=fine)
    lens = correct_lens(matches, ends, readout=readout)
    if not ends:
        matches.graph.see_by(table.camera)
        return
    own = correct_frame_lenses(matches)
    if lens or own or (is_open and fine):
        matches.measure(fine, anew=is_open and fine)
        let_lenses_move(matches, own.each)
        correct_rows(matches, finds_readout=False)
    if own:
        own = correct_frame_lenses(matches, own)
    if lens:
        lens = correct_lens(matches, ends, before=lens) or lens
    if lens or own:
        straighten(matches.keyframes, straight_views(table.camera, matches.camera, lens, own))
