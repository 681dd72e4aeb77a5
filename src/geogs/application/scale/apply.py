"""Conversion of a run's map to metres, at its end."""

from geogs.application.progress.run_progress import RunProgress
from geogs.application.scale.known_length import KnownLength, SensorScale, find_scale
from geogs.application.scale.measurable_scene import (
    MeasurableScene,
    SeenKeyframe,
    measurable,
    scale_sentence,
)
from geogs.errors import InputError
from geogs.io.sources.frame_source import Source
from geogs.on_demand import OnDemand
from geogs.slam import Slam
from geogs.tracking.graph.measured_odometry import OdometryAgreement


def make_metric(
    slam: Slam, stream: Source, source: KnownLength | SensorScale | None, progress: RunProgress
) -> None:
    """Scale the map to metres by a known length; if that fails, report it and leave the map."""
    if not slam.segments.keyframe_ids:
        return
    for sentence in sentences_on_poses(slam.segments.main.map.odometry.agreement()):
        progress.write(sentence)
    if source is None:
        slam.to_metres()
        return
    if isinstance(source, SensorScale):
        if slam.metric_scale is None:
            progress.write("warning: the scale is unknown: the map was not started from depth.")
        return
    try:
        found = find_scale(measurable_run(slam), source, stream.calibration)
    except InputError as why:
        progress.write(f"warning: the scale stays unknown. {why}")
        return
    slam.rescale(found)
    progress.write(scale_sentence(found))


def sentences_on_poses(found: OdometryAgreement) -> list[str]:
    """Sentences on the use of pose priors; none without them."""
    if not found.motions:
        return []
    fitting = f"{found.fitting:.0%} of {found.motions} motions between keyframes"
    if found.used:
        return [f"Poses beside the images: {fitting} fit what the images show."]
    return [
        f"warning: the poses beside the images are not used: only {fitting} fit what the images "
        "show. Are they of this video? --poses none leaves them out."
    ]


def measurable_run(slam: Slam) -> MeasurableScene:
    """The map of a run for the estimation of its scale."""

    def seen(id: int) -> SeenKeyframe:
        keyframe = slam.world.keyframes[id]
        return SeenKeyframe(keyframe.T_cw.numpy(), keyframe.image)

    keyframes = OnDemand(slam.segments.keyframe_ids, seen)
    return measurable(slam.camera, slam.renderer(), keyframes, slam.trajectory())
