"""What was seen through a lens that was found, as a pinhole sees it, once tracking has ended.

Images, depths, and what was found of the frames between keyframes go together, so that everything
can be matched and adjusted once more. Matches between keyframes do not: they are measured anew.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.projection import project
from geogs.camera.shutter.rows import CELL
from geogs.camera.straight_view import FrameViews, StraightView
from geogs.geometry.lie import se3_inverse
from geogs.threads import ordered_map, thread_map, worker_count
from geogs.tracking.frames.frame_recorder import sparse_cells
from geogs.tracking.frames.pose_filling import seen_by_keyframes, solved_poses
from geogs.tracking.frames.row_errors import seen_rows
from geogs.tracking.tracker import Tracker
from geogs.types import SeenRows
from geogs.world.archive import Archived
from geogs.world.edges import pack_matches, unpacked_positions
from geogs.world.frames import FrameLog
from geogs.world.keyframes import KeyframeSet

FARTHEST = 0.1
"""Fraction of the long edge; what seems to lie farther off straight has no match."""

TOGETHER = 16
"""Frames whose rows are straightened at a time; bounds memory."""


@dataclass(frozen=True)
class BentImages:
    """Images of keyframes as they were tracked, with a prior's normals and a sensor's depths.

    They stay in the file of the table as long as this is kept.
    """

    keyframes: KeyframeSet
    pieces: Mapping[str, Mapping[int, Archived]]

    @staticmethod
    def of(keyframes: KeyframeSet) -> "BentImages":
        """Those that there are now."""
        names = "image", "prior normal", "sensor depth"
        pieces = keyframes.table.arrays.pieces
        return BentImages(keyframes, {name: dict(pieces.get(name, {})) for name in names})

    def straighten(self, views: FrameViews) -> None:
        """Have the keyframes' images as the table's pinhole sees them, always made of those that
        were tracked; normals and depths go along pixel by pixel."""
        table, bent = self.keyframes.table, self.pieces["image"]
        arrays, ids = table.arrays, self.keyframes.ids
        view = {k.id: views.of(k.frame_index) for k in self.keyframes}
        images = ordered_map(lambda id: view[id].image(bent[id].load()), ids, worker_count())
        for id, image in zip(ids, images, strict=True):
            arrays.put("image", id, image, recent=True)
            arrays.recent("encoded").drop(id)
            for name in ("prior normal", "sensor depth"):
                if id in self.pieces[name]:
                    arrays.put(name, id, view[id].nearest(self.pieces[name][id].load()))
        table.lens = views.view.lens
        own = {k.id: views.own.get(k.frame_index) for k in self.keyframes}
        table.frame_lenses = {id: lens for id, lens in own.items() if lens is not None}


def straighten(tracker: Tracker, views: FrameViews, images: BentImages) -> None:
    """Have all that a tracker knows as the pinhole sees it that its images were taken for.

    Its graph has no edges then, as their matches are those of images that bend.
    """
    keyframes, graph, log = tracker.keyframes, tracker.map.graph, tracker.map.recorder.log
    poses = solved_poses(log, keyframes)
    images.straighten(views)
    graph.edges.clear()
    graph.refocus(1.0)
    straighten_cells(keyframes, views)
    straighten_frames(log, keyframes, views, poses)


def straighten_cells(keyframes: KeyframeSet, views: FrameViews) -> None:
    """Have what keyframes know of cells where straight images show it.

    Depths are interpolated; what a sensor or a prior says of them, and what moves, is that of the
    nearest cell.
    """
    grid = keyframes.grid
    for keyframe in keyframes:
        seen = views.of(keyframe.frame_index).bent(grid.pixels)
        nearest, is_cell = grid.cells_of(seen)
        fields = torch.stack([keyframe.inverse_depth, keyframe.information], 1)
        depth, information = grid.sample_field(fields, seen).unbind(1)
        keyframe.inverse_depth, keyframe.information = depth.clone(), information.clone()
        if keyframe.moving is not None:
            keyframe.moving = keyframe.moving[nearest] & is_cell
        if (prior := keyframe.prior) is not None:
            prior.values, prior.inverse_depth = prior.values[nearest], prior.inverse_depth[nearest]
            prior.information = torch.where(is_cell, prior.information[nearest], 0.0)
        if (measured := keyframe.measured) is not None:
            measured.inverse_depth = measured.inverse_depth[nearest]
            measured.information = torch.where(is_cell, measured.information[nearest], 0.0)


def straighten_frames(
    log: FrameLog,
    keyframes: KeyframeSet,
    views: FrameViews,
    T_cw: Mapping[int, Float[Tensor, "4 4"]],
) -> None:
    """Have what was found of the frames between straight keyframes where straight frames show it.

    Frames' images are no longer there. What a cell of a bent keyframe shows lies off it in the
    straight one; where it was found is straightened, and what lies on the cell is that far from it
    as the depths of both say at the frame's pose ``T_cw``. That is what is known now, not where
    tracking left the frame. Rows are those that straight pixels were seen in.
    """
    grid = keyframes.grid
    cells, camera = sparse_cells(grid), grid.camera
    for part, ids in seen_by_keyframes(log, keyframes):
        seen = [keyframes[k].frame_index for k in ids]
        shown = _each(views, seen, grid.pixels[cells].expand(len(ids), -1, 2))
        is_shown = shown.isfinite().all(-1)
        shown = torch.where(is_shown[..., None], shown, grid.pixels[cells])
        plane = (shown - shown.new_tensor([camera.cx, camera.cy])) / shown.new_tensor(
            [camera.fx, camera.fy]
        )
        rays = torch.cat([plane, torch.ones_like(plane[..., :1])], -1)
        T = torch.stack([T_cw[r.index] for r, _ in part]) @ se3_inverse(keyframes.poses(ids))
        depth = keyframes.inverse_depths(ids)
        found = unpacked_positions(grid, torch.stack([o.position for _, o in part]))
        found = _each(views, [r.index for r, _ in part], found)
        deep = [grid.sample_field(d[:, None], s)[:, 0] for d, s in zip(depth, shown, strict=True)]
        of_shown = project(camera, rays, T, torch.stack(deep))
        of_cell = project(camera, grid.rays[cells], T, depth[:, cells])
        pixels = found + (of_cell.pixels - of_shown.pixels)
        is_near = (pixels - found).norm(dim=-1) < FARTHEST * camera.long_edge
        good = is_shown & of_shown.valid & of_cell.valid & is_near
        weight = torch.stack([o.half_weight for _, o in part]).float()
        weight = torch.where(good[..., None], weight, 0.0)
        position, half_weight = pack_matches(grid, pixels.nan_to_num(), weight)
        for n, (_, observation) in enumerate(part):
            observation.position, observation.half_weight = position[n], half_weight[n]
            observation.shift = None
    indices = sorted(log.rows)
    size = 1 if views.own else TOGETHER
    parts = [indices[at : at + size] for at in range(0, len(indices), size)]
    straight = thread_map(
        lambda part: straight_rows([log.rows[n] for n in part], views.of(part[0])), parts
    )
    log.rows.update(zip(indices, chain.from_iterable(straight), strict=True))


def _each(
    views: FrameViews, frames: Sequence[int], pixels: Float[Tensor, "e p 2"]
) -> Float[Tensor, "e p 2"]:
    """Where straight images of some frames show what lies at pixels of theirs."""
    if not views.own:
        return views.view.straight(pixels)
    each = zip(frames, pixels, strict=True)
    return torch.stack([views.of(frame).straight(some) for frame, some in each])


def straight_rows(rows: Sequence[SeenRows], view: StraightView) -> list[SeenRows]:
    """Where and when the pixels of straight images of one size were seen, given that of the bent
    ones."""
    lines, columns = rows[0].seconds.shape
    v, u = torch.meshgrid(_nodes(lines), _nodes(columns), indexing="ij")
    nodes = torch.stack([u, v], -1).reshape(-1, 2)
    bent = view.bent(nodes)
    offsets, seconds = seen_rows(rows, torch.arange(len(rows)), bent.expand(len(rows), -1, 2))
    straight = view.straight(bent + offsets) - nodes
    offsets = torch.where(straight.isfinite(), straight, offsets)
    shape = len(rows), lines, columns
    both = zip(offsets.reshape(*shape, 2), seconds.reshape(shape), strict=True)
    return [
        replace(frame, offset=offset.to(frame.offset), seconds=at.to(frame.seconds))
        for frame, (offset, at) in zip(rows, both, strict=True)
    ]


def _nodes(count: int) -> Float[Tensor, "n"]:
    """Pixels of so many nodes along one side."""
    return (torch.arange(count) - 1) * CELL + (CELL - 1) / 2
