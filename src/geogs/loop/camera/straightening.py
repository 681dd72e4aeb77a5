"""Images of keyframes as the map's pinhole sees them, once the lens was found."""

from geogs.camera.straight_view import FrameViews
from geogs.threads import ordered_map, worker_count
from geogs.world.keyframes import KeyframeSet


def straighten(keyframes: KeyframeSet, views: FrameViews) -> None:
    """Have the images of keyframes as the table's pinhole sees them.

    A prior's normals and a sensor's depths go along pixel by pixel. What was matched stays that of
    the images as they were tracked.
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
