"""The choices of the GeoGS-SLAM paper, where it makes one; docs/paper.md goes through them.

What the paper leaves open (all weights, most thresholds) has the value that its sources have, or
ours where these do not fit.
"""

from dataclasses import replace

from geogs.config.loss_config import LossAblation, LossConfig
from geogs.config.mapping_config import (
    DepthConfig,
    DiskConfig,
    MapAblation,
    MappingConfig,
    PhotoConfig,
)
from geogs.config.prior_config import PriorConfig
from geogs.config.tracking_config import LoopConfig, TrackingConfig

LONG_EDGE = 616
"""Pixels; as large as the front ends that the paper builds on have Replica's images."""
_UNBOUNDED = 1e6


def paper_losses() -> LossConfig:
    """All terms as printed, none weighted by confidence, made robust or added."""
    return LossConfig(
        depth_weight=1.0,
        edge_factor=1.0,
        normal_weight=0.05,
        normal_consistency_weight=0.05,
        distortion_weight=0.05,
        opacity_weight=0.0,
        silhouette_weight=0.0,
        smoothness_weight=0.02,
        l1_weight=0.8,
        l1_huber=0.0,
        l1_cut=10.0,
        ncc_weight=0.15,
        ncc_patch=7,
        ncc_reject=2.0,
        photo_texture=0.0,
        ssim_weight=0.2,
        occlusion_ratio=0.05,
        colour=True,
        photo_blur=0.0,
        ablation=LossAblation(depth_relative=False, smoothness_rewards_edges=True),
    )


def paper_disks() -> DiskConfig:
    """Local planes with the paper's shrink factor; scales as they come; no votes on free space."""
    return DiskConfig(
        stride=8,
        edge_stride=8,
        insert_confidence=0.5,
        fill_confidence=0.5,
        fit_normals=False,
        scale_factor=1.0,
        bound_spacing=False,
        planarity_threshold=0.3,
        planarity_shrink=0.1,
        opacity=0.5,
        max_scale=_UNBOUNDED,
        min_scale=1e-7,
        carve=False,
    )


def paper_mapping() -> MappingConfig:
    """Mapping of a run: depth of the front end, the summed window, seven steps, no refinement."""
    return MappingConfig(
        render_long_edge=LONG_EDGE,
        photo_scale=1.0,
        lag=0,
        window=11,
        iterations=7,
        views_per_step=0,
        final_iterations=0,
        pose_iterations=5,
        pose_every=1,
        pose_lr=4e-4,
        max_spread=_UNBOUNDED,
        plane_reach=0.0,
        disk=paper_disks(),
        photo=PhotoConfig(per_step=1, fresh=True, compensate_exposure=False),
        depth=DepthConfig(engine="tracker", bare_planes=False),
        loss=paper_losses(),
        ablation=MapAblation(map_update="coherent"),
    )


def paper_known_pose_mapping(usual: MappingConfig) -> MappingConfig:
    """Mapping from known poses: there is no front end, so its depth and normals have no weight.

    Where disks start is unpublished; ours start from searched depths, as is ``usual``.
    """
    return replace(
        usual,
        depth=replace(usual.depth, bare_planes=False),
        photo_scale=1.0,
        max_spread=_UNBOUNDED,
        plane_reach=0.0,
        disk=replace(paper_disks(), insert_confidence=0.3, fill_confidence=0.1),
        photo=PhotoConfig(
            candidates=8, max_view_angle=30.0, per_step=1, fresh=True, compensate_exposure=False
        ),
        loss=replace(paper_losses(), depth_weight=0.0, normal_weight=0.0),
    )


def paper_tracking() -> TrackingConfig:
    """DROID-SLAM's network where its file is found, and the paper's keyframes: a mean motion of 2.4
    cells of 8 pixels makes one, which stays, so that it is mapped as soon as it exists."""
    return TrackingConfig(
        operator="droid_if_found", keyframe_mean_flow=0.031, keyframe_distance=0.0
    )


def paper_loops() -> LoopConfig:
    """Loops among places that the present poses show together, closed with all their matches."""
    return LoopConfig(min_gap=52, appearance=0, residual=0.0, matches=True)


def paper_prior() -> PriorConfig:
    """JDSA's scale field of two by two nodes, free of each other; no prior is rejected."""
    return PriorConfig(scale_rows=2, scale_columns=2, scale_step=10.0, reject=False)
