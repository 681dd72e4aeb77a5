"""Straightening of keyframe images for the map's pinhole, once the lens is estimated."""

from geogs.camera.straight_view import FrameViews
from geogs.threads import ordered_map, worker_count
from geogs.world.keyframes import KeyframeSet


def straighten(keyframes: KeyframeSet, views: FrameViews) -> None:
    """Straighten the images of keyframes to the table's pinhole.

    A prior's normals and a sensor's depths are resampled, too. Matches still belong to the images
    as tracked.
    """
    table, ids = keyframes.table, keyframes.ids
    arrays, view = table.arrays, {k.id: views.of(k.frame_index) for k in keyframes}
    images = ordered_map(
        lambda id: view[id].image(keyframes[id].image), ids, worker_count()
    )  # fmt: skip
    for id, image in zip(ids, images, strict=True):
        arrays.put("image", id, image, recent=True)
        arrays.recent("encoded").drop(id)
        for name in ("prior normal", "sensor depth"):
            if (seen := arrays.get(name, id)) is not None:
                arrays.put(name, id, view[id].nearest(seen))
    table.lens = views.view.lens
    own = {k.id: views.own.get(k.frame_index) for k in keyframes}
    table.frame_lenses = {id: lens for id, lens in own.items() if lens is not None}
