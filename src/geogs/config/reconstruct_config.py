"""All settings of a reconstruction from known poses, and their presets."""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated

from geogs.config.arguments import checks_arguments
from geogs.config.input_config import InputConfig
from geogs.config.loss_config import LossConfig
from geogs.config.mapping_config import DepthConfig, MappingConfig, PhotoConfig
from geogs.config.mesh_config import MeshConfig
from geogs.config.paper import paper_known_pose_mapping
from geogs.config.run_config import Preset, Seed
from geogs.config.setting import RARE, Basic, Count, Range, Settings


@dataclass(frozen=True)
class SearchConfig(Settings, group="search"):
    """Effort for a map from known poses, and the search for depth."""

    steps_per_view: Count = 30
    """Training steps for every image where no time is given."""
    least_steps: Count = 300
    """Fewest training steps where no time is given."""
    most_steps_per_view: Count = 200
    """Most training steps for every image, whatever the time."""
    most_views: Annotated[int, Range(2, 100_000), Basic()] = 400
    """Most images that make the map. Of more, and of as many as the time lasts for, those are read
    that see all of the scene from places apart; of near ones the sharper."""
    depth_ratio: Annotated[float, Range(1e-3, 1)] = 0.25
    """Largest fraction of the time up to then that reading and the depths may take; images for
    which it does not last are not read, or get no depth and only serve to find those of the
    others."""
    repeat: bool = True
    """Search all depths a second time, between the limits that the first time has shown."""


def known_pose_mapping() -> MappingConfig:
    """Mapping where poses are exact, so that images may be compared more strictly than in a run.

    What is hidden is told by less, windows that do not match are left out sooner, disks move in
    smaller steps, and depths are searched without the network, which is less precise than what
    exact poses allow.
    """
    loss = LossConfig(depth_weight=0.5, ncc_reject=0.5, occlusion=1.0)
    return MappingConfig(
        lr_position=3e-4,
        lr_final=0.03,
        max_spread=0.003,
        plane_reach=0.006,
        photo=PhotoConfig(per_step=4),
        depth=DepthConfig(engine="classical"),
        loss=loss,
    )


@dataclass(frozen=True)
class ReconstructConfig(Settings):
    """All settings of a reconstruction from known poses."""

    seed: Annotated[Seed, RARE] = 0
    """Random seed; same seed, same machine and no time limit, same result on the CPU."""
    resident_keyframes: Annotated[Count, RARE] = 128
    """Keyframes whose images, depths and the like stay in memory or on the GPU, those used last;
    others wait in a temporary file. More than the window that is mapped and its history."""
    input: InputConfig = field(default_factory=InputConfig)
    search: SearchConfig = field(default_factory=SearchConfig)
    mapping: MappingConfig = field(default_factory=known_pose_mapping)
    mesh: MeshConfig = field(default_factory=partial(MeshConfig, detail=0.5))


@checks_arguments
def reconstruct_preset(name: Preset) -> ReconstructConfig:
    """The settings of a preset for known poses.

    ``fast`` works on small images and searches depths once; ``accurate``, for a GPU, renders at the
    size of the images; ``paper`` is the latter with the losses and the start of the paper.
    """
    base = ReconstructConfig()
    if name == "fast":
        return replace(
            base,
            input=replace(base.input, long_edge=400),
            search=replace(base.search, repeat=False, steps_per_view=15),
            mapping=replace(base.mapping, render_long_edge=256),
        )
    if name in ("accurate", "paper"):
        disk = replace(base.mapping.disk, stride=5, edge_stride=3)
        mapping = replace(base.mapping, render_long_edge=800, photo_scale=1.0, disk=disk)
        return replace(
            base,
            input=replace(base.input, long_edge=800),
            search=replace(base.search, steps_per_view=200, most_steps_per_view=1000),
            mapping=mapping if name == "accurate" else paper_known_pose_mapping(mapping),
        )
    return base
