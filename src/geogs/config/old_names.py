"""Names of settings in the version before this one; this file goes with the next."""

import logging
from collections.abc import Mapping
from typing import Any

from geogs.config.setting import dashed
from geogs.errors import InputError

RENAMED = {
    "loop.strain": "loop.residual",
    "mapping.depth.max-planes": "mapping.depth.planes",
    "mapping.loss.occlusion-share": "mapping.loss.occlusion-ratio",
    "mapping.photo.level": "mapping.photo.compensate-exposure",
    "mapping.photo.looking-within": "mapping.photo.max-view-angle",
    "odometry.turn": "odometry.rotation-drift",
    "search.depth-share": "search.depth-ratio",
    "sensor.share": "sensor.ratio",
    "tracking.keyframe-flow": "tracking.keyframe-parallax",
}
"""Present names by the old ones."""
_REMOVED = {
    "calibration": (
        "enough frames keyframe-flow keyframes min-parallax start-keyframes stretches sure too-much"
    ),
    "loop": (
        "agreeing join-tolerance kept lag max-angle max-baseline max-distance max-loops measured "
        "min-score rotation-weight suppression verified"
    ),
    "loop.retrieval": "fast-threshold features indexed word-radius words",
    "loop.verification": (
        "depth-tolerance epipolar max-contradiction max-residual max-scale max-turn "
        "min-consistent min-epipolar min-inliers min-matched min-matched-alone min-ncc min-share "
        "min-spread ratio reprojection"
    ),
    "mapping.depth": (
        "agreement-reach average-reach bending edge-sharpness fit-deviation fit-radius "
        "fit-stiffness fit-tolerance guide-contrast jump-contrast large-jump max-baseline-cosine "
        "max-parallax max-turn membrane min-parallax min-planes neighbours network-edge parallax "
        "patch-contrast photo-deviation plane-deviation plane-step prior-pull prior-tolerance "
        "range-deviation range-margin refine-steps repair-below repair-confidence repair-votes "
        "sigma-scale small-jump step-limit support-radius support-sharpness sure-deviation "
        "tracker-scale variance-floor violation-distance vote-confidence vote-free-views "
        "vote-support vote-violation window"
    ),
    "mapping.disk": (
        "carve-every insert-alpha insert-behind neighbours prune-opacity split-pixels split-ratio "
        "split-share split-times"
    ),
    "mapping": "final-pose-rounds history lr-opacity lr-quaternion lr-scale",
    "mapping.loss": "min-alpha ncc-min-coverage ncc-min-variance smoothness-eta",
    "mapping.loss.ablation": "photo-gradient",
    "mapping.photo": "max-parallax min-parallax parallax",
    "mesh": "close-holes max-depth min-component-fraction voxel-per-pixel",
    "odometry": "agreement rotation",
    "prior": "caution depth deviation max-deviation reach reject rounds",
    "search": "first-batch first-edge first-views margin output-share",
    "sensor": "edge far lateral near",
    "tracking": (
        "blur-share blur-wait cull-distance depth-window global-distance global-iterations "
        "global-pairs global-remeasure global-rounds global-suppression huber local-iterations "
        "local-rounds max-residual min-known min-matched min-ncc min-parallax min-texture "
        "proximity-distance proximity-pairs proximity-window radius recognised relocalise "
        "remeasure start-deviation start-overlap window-baseline window-most"
    ),
}
REMOVED = frozenset(f"{group}.{name}" for group in _REMOVED for name in _REMOVED[group].split())
"""Constants now."""

_log = logging.getLogger(__name__)


def present_name(name: str) -> str:
    """What an option, or the switch that turns one off, is called now; warns where it was renamed.

    Raises:
        InputError: it is no longer a setting.
    """
    group, _, own = name.rpartition(".")
    no = "no-" if own.startswith("no-") else ""
    old = f"{group}.{own.removeprefix('no-')}"
    if old in REMOVED:
        raise InputError(f"{old} is no longer a setting; its value is fixed.")
    if old not in RENAMED:
        return name
    group, _, own = RENAMED[old].rpartition(".")
    _log.warning("%s is called %s now; the old name goes with the next version.", old, RENAMED[old])
    return f"{group}.{no}{own}"


def present_values(said: Mapping[str, Any], group: str, where: str) -> dict[str, Any]:
    """Values of a group's settings, as a file has them, by the present names of their fields.

    Of what is no longer a setting a warning tells, which calls the file by ``where``.
    """
    names = {field: f"{group}.{dashed(field)}" for field in said}
    removed = [name for name in names.values() if name in REMOVED]
    if removed:
        are = "are no longer settings" if len(removed) > 1 else "is no longer a setting"
        _log.warning("%s in %s %s and left out.", ", ".join(removed), where, are)
    present = {field: RENAMED.get(name, name) for field, name in names.items()}
    return {
        present[field].removeprefix(f"{group}.").replace("-", "_"): value
        for field, value in said.items()
        if names[field] not in REMOVED
    }
