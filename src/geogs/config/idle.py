"""Settings that change nothing beside others: what to tell who has given them."""

from collections.abc import Iterator
from operator import attrgetter

from geogs.config.mapping_config import MappingConfig
from geogs.config.prior_config import DepthSensorConfig, OdometryConfig
from geogs.config.reconstruct_config import ReconstructConfig
from geogs.config.run_config import Config, preset, preset_of
from geogs.config.setting import dashed

ON_THE_WAY = (
    "lag",
    "window",
    "views_per_step",
    "final_depth",
    "pose_iterations",
    "pose_every",
    "pose_lr",
    "ablation.map_update",
)
"""Settings of the mapping that act on nothing but a map that is made while frames come."""


def idle_settings(
    config: Config | ReconstructConfig, maps_at_end: bool = False, is_live: bool = False
) -> list[str]:
    """A sentence for every setting that was changed and does nothing, with what it would need.

    ``maps_at_end`` says that a run makes its map of all keyframes at once, after the video,
    ``is_live`` that its frames do not wait.
    """
    if isinstance(config, ReconstructConfig):
        return list(_mapping(config.mapping))
    of_map = _deferred(config) if maps_at_end else _on_the_way(config.mapping, is_live)
    return [*_run(config), *of_map, *_mapping(config.mapping)]


def _deferred(config: Config) -> Iterator[str]:
    mapping = config.mapping
    usual = preset(preset_of(config)).mapping
    if not usual.may_follow:  # what such a preset sets is meant for a map that is made on the way
        usual = MappingConfig()
    changed = [path for path in ON_THE_WAY if attrgetter(path)(mapping) != attrgetter(path)(usual)]
    idle = [f"mapping.{dashed(path)}" for path in changed]
    if idle:
        yield (
            f"{', '.join(idle)} {'does' if len(idle) == 1 else 'do'} nothing: the map is made of "
            "all keyframes at once after the video; mapping.when online makes it on the way."
        )


def _on_the_way(mapping: MappingConfig, is_live: bool) -> Iterator[str]:
    if is_live and mapping.pose_iterations not in (0, MappingConfig.pose_iterations):
        yield (
            "mapping.pose-iterations does nothing: a live run leaves poses to the tracker, which "
            "does not wait for the map."
        )
    if mapping.final_iterations == 0 and not mapping.final_depth:
        yield (
            "mapping.no-final-depth does nothing: with mapping.final-iterations 0 no depth is "
            "searched again."
        )
    for name in ("pose_lr", "pose_every") if mapping.pose_iterations == 0 else ():
        if getattr(mapping, name) != getattr(MappingConfig, name):
            yield f"mapping.{dashed(name)} does nothing: mapping.pose-iterations is 0."


def _run(config: Config) -> Iterator[str]:
    tracking = config.tracking
    prior = config.prior
    mapping = config.mapping
    if tracking.weights and tracking.operator in ("auto", "classical"):
        yield (
            "tracking.weights does nothing: the classical operator has none; tracking.operator "
            "own or droid takes them."
        )
    if prior.card and not prior.model:
        yield "prior.card does nothing without prior.model."
    if prior.normal_card and not prior.normal_model:
        yield "prior.normal-card does nothing without prior.normal-model."
    if config.input.depth == "none" and config.sensor != DepthSensorConfig():
        yield "sensor does nothing: input.depth is none, so that no measured depth is used."
    if config.input.poses == "none" and config.odometry != OdometryConfig():
        yield "odometry does nothing: input.poses is none, so that no measured pose is used."
    if mapping.when == "after" and not mapping.may_follow:
        yield (
            "mapping.when after does nothing: without a final training the map is made on the way."
        )
    if config.loop.matches and not config.loop.enabled:
        yield "loop.matches does nothing: loop closing is off."


def _mapping(mapping: MappingConfig) -> Iterator[str]:
    loss = mapping.loss
    if mapping.depth.weights and mapping.depth.engine in ("classical", "tracker"):
        yield (
            f"mapping.depth.weights does nothing: the engine {mapping.depth.engine} has none; "
            "network or joint takes them."
        )
    if loss.colour and max(loss.l1_weight, loss.ssim_weight) == 0:
        yield "mapping.loss.colour does nothing: L_1 and L_ssim have no weight."
