"""Self-calibration before a run: focal length, shutter and overlay mask, where none was given."""

import math
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from jaxtyping import UInt8

from geogs.application.interrupt import Stop
from geogs.application.progress.run_progress import RunProgress
from geogs.camera.shutter.shutter import FoundReadout, Shutter
from geogs.config import Config
from geogs.errors import InputError
from geogs.io.sources.calibration import Calibration, FocalRefinement
from geogs.io.sources.frame_source import Source
from geogs.io.sources.posed.posed_source import PosedSource
from geogs.types import FoundLens

if TYPE_CHECKING:
    from geogs.tracking.calibration.self_calibration import SelfCalibration
    from geogs.tracking.calibration.unknowns import Unknowns

Report = Callable[[float], None]


def without_overlay(source: Source, progress: RunProgress | None = None) -> Source:
    """Mask out the parts of all images that show no scene, if no mask was given: bars and other
    borders, and static overlays such as a time stamp, a logo or a bonnet.

    Raises:
        InputError: the images are stereo pairs or panoramas.
    """
    if not source.is_overlay_open and source.takes == "none":
        return source
    from geogs.io.sources.borders import find_border
    from geogs.io.sources.static_overlay import IMAGES, LEAST_FRAMES, is_turntable, static_overlay

    images = source.spread(IMAGES)
    check_pinhole(source, images)
    if not source.is_overlay_open:
        return source
    progress = progress or RunProgress()
    keep = "--input.no-mask-overlay keeps it."
    border = find_border(images)
    if border is not None:
        size = source.calibration.camera().long_edge
        progress.write(f"note: {border.sentence(size)} and are masked out. {keep}")
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images]
    is_long = source.length is None or source.length >= LEAST_FRAMES
    found = static_overlay(grey) if is_long and border is None else None
    if found is not None:
        progress.write(
            f"note: {found.mean():.1%} of each image never changes, as a time stamp or a bonnet, "
            f"and is masked out. {keep}"
        )
    elif is_long and is_turntable(grey):
        progress.write(
            "warning: only the middle of the images moves, before a background that stands still, "
            "as on a turntable: give --mask FOLDER with masks that show the object alone."
        )
    mask = border.mask_of(*images[0].shape[:2]) if border is not None else found
    return source if mask is None else source.without_overlay(mask)


def warn_of_border(source: PosedSource, progress: RunProgress) -> None:
    """Say where images with known poses have borders that show no scene."""
    from geogs.io.sources.borders import find_border
    from geogs.io.sources.static_overlay import LEAST_IMAGES

    chosen = np.unique(np.linspace(0, len(source) - 1, 2 * LEAST_IMAGES).round().astype(int))
    try:
        images = [source[int(index)].image for index in chosen]
    except InputError:  # which the reading of all will say
        return
    if (border := find_border(images)) is not None:
        progress.write(
            f"warning: {border.sentence(source.camera.long_edge)}: they become surfaces. Crop the "
            "images, and move the principal point by as much."
        )


def check_pinhole(source: Source, images: Sequence[UInt8[np.ndarray, "h w 3"]]) -> None:
    """Raise InputError where images spread over a source are stereo pairs or panoramas."""
    from geogs.io.sources.views import no_pinhole

    found = None if source.takes == "none" else no_pinhole(images)
    if found is not None:
        taken = "" if source.takes == "auto" else f"{source.takes}+"
        raise InputError(
            f"{source.name} {found.replace('--take ', f'--take {taken}')} (--take none uses all)."
        )


def self_calibrated(
    source: Source,
    config: Config | None = None,
    device: str | torch.device = "cpu",
    progress: RunProgress | None = None,
    stop: Stop | None = None,
    finds_readout: bool = True,
) -> Source:
    """Estimate the unknown camera parameters of the source from the video, in one adjustment.

    These are the focal length and the distortion where they are a guess or nominal and may be
    refined, and the readout of the shutter. Where the video does not determine them, or after a
    request to stop, the guess stays, the shutter counts as global, and ``progress`` reports it.
    Without ``finds_readout`` the shutter stays as it is.
    """
    config = config or Config()
    progress = progress or RunProgress()
    stop = stop or Stop()
    asks_lens = config.calibration.refine and source.is_calibration_open
    if source.calibration.is_guess and not asks_lens:
        progress.write(
            f"warning: the intrinsics are unknown; assuming {source.intrinsics_origin}. Give "
            "--intrinsics fx,fy,cx,cy for a better result."
        )
    asks_readout = finds_readout and source.is_shutter_open
    if not (asks_lens or asks_readout):
        return source
    unknowns = _unknowns(source, asks_lens, config.calibration.radial)
    found = _found(progress, stop, partial(_self_calibration, source, unknowns, device))
    if found is None:
        progress.write(
            f"Calibration stopped; going on with {source.intrinsics_origin} and "
            f"{'a global' if source.is_shutter_open else 'the given'} shutter. Press Ctrl-C again "
            "to end."
        )
        return source
    known = source
    if asks_lens:
        calibration = refined(source.calibration, source.camera.fx, found)
        progress.write(_calibration_sentence(calibration, source.intrinsics_origin))
        known = known.with_calibration(calibration)
    if asks_readout:
        known = known.with_shutter(_shutter(found.readout))
        if found.readout.is_believed:
            progress.write(
                f"Rolling shutter: {_evidence(found.readout)} from the first to the last row; rows "
                "are rectified."
            )
    return known


def _unknowns(source: Source, asks_lens: bool, radial: bool) -> "Unknowns":
    """Parameters to estimate; an unknown lens is one, too, where only the readout is wanted."""
    from geogs.tracking.calibration.unknowns import Unknowns

    readout = None if source.is_shutter_open else source.shutter.readout
    calibration = source.calibration
    may_bend = radial if asks_lens else calibration.is_unknown_lens
    return Unknowns(
        focal=asks_lens or calibration.is_guess,
        radial=may_bend and not calibration.is_distorted,
        rolling=None if readout == 0 else source.rolling_camera,
        readout=readout,
    )


def _self_calibration(
    source: Source, unknowns: "Unknowns", device: str | torch.device, report: Report
) -> "SelfCalibration":
    from geogs.tracking.calibration.self_calibration import self_calibrate

    with closing(source.as_recorded()) as frames:
        return self_calibrate(
            frames, source.camera, unknowns, device, report, source.mask, source.black_is_masked
        )


def refined(
    calibration: Calibration, working_focal: float, found: "SelfCalibration"
) -> Calibration:
    """Update a calibration of the source's images by the estimate on its working images.

    ``working_focal`` is fx of the working images by ``calibration``, in their pixels.
    """
    if found.failure is not None:
        from geogs.tracking.calibration.degeneracy import Degeneracy

        said = FocalRefinement(
            keyframes=found.keyframes,
            frames=found.frames,
            failure=found.failure,
            is_explained=found.failure != Degeneracy.UNEXPLAINED.value,
        )
        origin = f"{calibration.origin}; not estimated from the video: {found.failure}"
        return replace(calibration, origin=origin, refinement=said)
    factor = found.camera.fx / working_focal
    focal = calibration.fx * factor
    deviation = found.deviation * focal
    was = "was assumed" if calibration.is_guess else f"says {calibration.fx:.1f}"
    origin = f"refined from the video: {focal:.1f} +- {deviation:.1f} pixels"
    if found.squeeze != 1:
        origin += f", fy / fx {found.squeeze:.3f}: the pixels are no squares"
    distortion = calibration.distortion
    if found.distortion is not None:
        distortion = (*found.distortion, 0.0, 0.0)
    if found.deviations is not None:
        for name, k, error in zip(("k1", "k2"), distortion, found.deviations, strict=False):
            origin += f", {name} {k:.4f} +- {error:.4f}"
    said = FocalRefinement(deviation, found.deviations, found.keyframes, found.frames)
    return replace(
        calibration,
        fx=focal,
        fy=calibration.fy * factor * found.squeeze,
        distortion=distortion,
        origin=f"{origin} ({calibration.origin} {was})",
        is_guess=False,
        is_nominal=False,
        refinement=said,
    )


def _calibration_sentence(calibration: Calibration, assumed: str) -> str:
    failure = calibration.refinement.failure if calibration.refinement is not None else None
    if failure is None:
        return f"Intrinsics: {calibration.origin}."
    return (
        f"warning: the focal length could not be estimated before the run: {failure}. Assuming "
        f"{assumed}; it is estimated again at the end. Move sideways and turn while recording, or "
        "give --intrinsics fx,fy,cx,cy."
    )


def lens_sentence(before: Calibration, found: FoundLens, after: Calibration) -> str:
    """Message with the lens estimated by the final adjustment, and how to reuse it."""
    changes = []
    if found.focal != 1:
        deviation = found.deviation_focal * after.fx
        changes.append(f"fx {after.fx:.1f} +- {deviation:.1f} pixels (was {before.fx:.1f})")
    if found.is_off_centre:
        deviation = found.deviation_centre * after.fx
        changes.append(f"principal point {after.cx:.1f}, {after.cy:.1f} +- {deviation:.1f}")
    if found.varies_focal > 0:
        changes.append(f"fx varies by {found.varies_focal:.2%} from image to image")
    if found.varies_centre > 0:
        pixels = found.varies_centre * after.fx
        changes.append(f"the principal point varies by {pixels:.1f} pixels from image to image")
    changes.append(f"k1 {found.k1:.4f} +- {found.deviation_k1:.4f}")
    changes.append(f"k2 {found.k2:.4f} +- {found.deviation_k2:.4f}")
    beside = " beyond the distortion given" if before.is_distorted else ""
    return (
        f"Lens re-estimated: {', '.join(changes)}{beside}. Reuse it: --intrinsics {after.numbers} "
        "(or intrinsics.json)."
    )


def _shutter(found: FoundReadout) -> Shutter:
    """The estimated shutter; global where the estimate is not accepted."""
    if not math.isfinite(found.error):
        return Shutter(origin="could not be estimated from the video", error=found.left_open)
    return Shutter(found.readout, f"the video says {_evidence(found)}", found.left_open)


def _evidence(found: FoundReadout) -> str:
    return f"{1000 * found.best:.1f} +- {1000 * found.error:.1f} ms"


def _found(
    progress: RunProgress, stop: Stop, find: Callable[[Report], "SelfCalibration"]
) -> "SelfCalibration | None":
    """Run a self-calibration; none after a request to stop."""

    def report(fraction: float) -> None:
        progress.stage("calibration", fraction)
        stop.check()

    with stop:
        try:
            return find(report)
        except KeyboardInterrupt:
            if not stop.requested:
                raise
            return None
