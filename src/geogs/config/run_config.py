"""All settings of a run, and their presets."""

from dataclasses import dataclass, field, replace
from typing import Annotated, Literal, get_args

from geogs.config.arguments import checks_arguments
from geogs.config.input_config import InputConfig
from geogs.config.mapping_config import MappingConfig
from geogs.config.mesh_config import MeshConfig
from geogs.config.paper import LONG_EDGE, paper_loops, paper_mapping, paper_prior, paper_tracking
from geogs.config.prior_config import DepthSensorConfig, OdometryConfig, PriorConfig
from geogs.config.setting import RARE, Count, Range, Settings
from geogs.config.tracking_config import CalibrationConfig, LoopConfig, TrackingConfig

Preset = Literal["default", "fast", "accurate", "paper"]
Seed = Annotated[int, Range(0, 2**32 - 1)]


@dataclass(frozen=True)
class Config(Settings):
    """All settings of a run."""

    seed: Annotated[Seed, RARE] = 0
    """Random seed; same seed, same machine, same result on the CPU."""
    resident_keyframes: Annotated[Count, RARE] = 128
    """Keyframes whose images, depths and the like stay in memory or on the GPU, those used last;
    others wait in a temporary file. More than the window that is mapped and its history."""
    input: InputConfig = field(default_factory=InputConfig)
    sensor: DepthSensorConfig = field(default_factory=DepthSensorConfig)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    prior: PriorConfig = field(default_factory=PriorConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    mesh: MeshConfig = field(default_factory=MeshConfig)


def preset_of(config: Config) -> Preset:
    """The preset by which a run makes its map: that from which fewest settings of it differ."""

    def changed(name: Preset) -> int:
        return min(
            sum(a != b for a, b in zip(_values(usual.mapping), own, strict=True))
            for usual in (preset(name), preset(name, on_gpu=True))
        )

    own = _values(config.mapping)
    return min(get_args(Preset), key=changed)


def _values(settings: Settings) -> list[object]:
    """All settings of a group and the groups in it, in their order."""
    found = list[object]()
    for value in vars(settings).values():
        found += _values(value) if isinstance(value, Settings) else [value]
    return found


@checks_arguments
def preset(name: Preset, on_gpu: bool = False) -> Config:
    """The settings of a preset.

    ``default`` takes larger images on a GPU and renders at their size; ``accurate`` does so
    anywhere and trains longer; ``fast`` matches all keyframes at half resolution in the end and
    maps at a smaller size; ``paper`` does what the GeoGS-SLAM paper does.
    """
    base = Config()
    if name == "accurate" or (name == "default" and on_gpu):
        disk = replace(base.mapping.disk, stride=6, edge_stride=3)
        mapping = replace(base.mapping, render_long_edge=640, disk=disk)
        base = replace(base, input=replace(base.input, long_edge=640), mapping=mapping)
    if name == "fast":
        mapping = replace(
            base.mapping,
            render_long_edge=192,
            iterations=5,
            pose_iterations=0,
            final_iterations=400,
            final_depth=False,
            depth=replace(base.mapping.depth, engine="classical", planes=96),
        )
        return replace(
            base,
            tracking=replace(base.tracking, fine_adjustment=False),
            mapping=mapping,
            mesh=replace(base.mesh, triangle_budget=500_000),
        )
    if name == "accurate":
        return replace(base, mapping=replace(base.mapping, iterations=15, final_iterations=3000))
    if name == "paper":
        return replace(
            base,
            input=replace(base.input, long_edge=LONG_EDGE),
            tracking=paper_tracking(),
            prior=paper_prior(),
            loop=paper_loops(),
            mapping=paper_mapping(),
        )
    return base
