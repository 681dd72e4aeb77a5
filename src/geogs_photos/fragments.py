"""What is tried where incremental mapping of a video falls into parts, or leaves frames out.

Global mapping (rotation averaging, global positioning, adjustment; Pan et al. 2024) takes all pairs
at once. It comes second, as it takes twice the time of incremental mapping and places neither more
nor better what that places whole. At last matches are verified once more with the focal length of
the largest part, which short parts cannot tell, and mapped incrementally.
"""

import shutil
from collections import Counter
from collections.abc import Callable, Container, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from geogs_photos.contradictions import undisputed
from geogs_photos.database import SharedCamera
from geogs_photos.incremental_mapping import (
    LEAST_POINTS,
    largest_first,
    placed_images,
    put_together,
)
from geogs_photos.pycolmap_library import load_colmap

LEAST_VIEWS = 3
"""Pictures that see a point which passes the scale on from one to another."""
WHOLE = 0.9
"""Part of the frames that one reconstruction has to hold for nothing else to be tried."""


def rejoined(
    parts: Sequence[Any],
    database: Path,
    count: int,
    cameras: Sequence[SharedCamera],
    seed: int,
    threads: int,
    progress: Callable[[str, float], None],
) -> list[Any]:
    """Reconstructions by the way that puts most frames into one; ``parts`` are by the first.

    Args:
        parts: by incremental mapping, the largest first.
        database: with verified matches of ``count`` frames.
        count: how many frames there are.
        cameras: of the frames.
        seed: of the random choices.
        threads: to compute with.
        progress: called with a stage and its finished part; what it raises ends the work.
    """
    best = _believed(parts, database)
    is_known = all(camera.is_known for camera in cameras)
    if _placed(best) < WHOLE * count:
        progress("finding poses globally", 0.0)
        once = _globally(database, is_known, seed, threads)
        best = max(best, _believed(once, database), key=_placed)
        progress("finding poses globally", 1.0)
    if best and _placed(best) < WHOLE * count and not is_known:
        again = _with_camera_of(
            best[0], database, count, seed, threads, lambda f: progress("finding poses again", f)
        )
        best = max(best, _believed(again, database), key=_placed)
    return best


def believed(model: Any, database: Path, known: Container[int] = ()) -> Any:
    """What of a reconstruction hangs together, and contradicts no matches.

    With pictures ``known`` from elsewhere it is what does with these.
    """
    return firmly_joined(undisputed(model, database, known), known)


def firmly_joined(model: Any, known: Container[int] = ()) -> Any:
    """The largest part of a reconstruction whose scale is one; the other pictures lose their poses.

    With pictures ``known`` from elsewhere it is all that hangs together with one of them.

    Between two pictures scale is passed on by points that a third one sees as well. Where only a
    few such points join two parts, how large and how far one is as seen from the other is made up.
    """
    shared: Counter[tuple[int, int]] = Counter()
    for point in model.points3D.values():
        seen_by = sorted({element.image_id for element in point.track.elements})
        if len(seen_by) >= LEAST_VIEWS:
            shared.update(combinations(seen_by, 2))
    images = sorted(image.image_id for image in model.images.values() if image.has_pose)
    place = {number: k for k, number in enumerate(images)}
    joined = [(place[a], place[b]) for (a, b), count in shared.items() if count >= LEAST_POINTS]
    rows, columns = ([pair[k] for pair in joined] for k in (0, 1))
    graph = coo_array(([1] * len(joined), (rows, columns)), shape=(len(images), len(images)))
    _, part = connected_components(graph, directed=False)
    of = dict(zip(images, part.tolist(), strict=True))
    kept = {of[n] for n in images if n in known}
    if not kept and images:
        kept = {Counter(of.values()).most_common(1)[0][0]}
    for number, own in of.items():
        if own not in kept:
            model.deregister_frame(model.images[number].frame_id)
    model.tear_down()  # lets go of pictures without a pose, which covariances stumble over
    return model


def _believed(parts: Sequence[Any], database: Path) -> list[Any]:
    """What is to be believed of each; the largest first."""
    return sorted((believed(part, database) for part in parts), key=lambda part: -_placed([part]))


def _placed(parts: Sequence[Any]) -> int:
    return len(placed_images(parts[0])) if parts else 0


def _globally(database: Path, is_known: bool, seed: int, threads: int) -> list[Any]:
    colmap = load_colmap()
    options = colmap.GlobalPipelineOptions(num_threads=threads, random_seed=seed)
    mapper = options.mapper
    mapper.random_seed, mapper.num_threads = seed, threads
    for stage in (mapper.rotation_averaging, mapper.global_positioning, mapper.retriangulation):
        stage.random_seed = seed
    adjustment = mapper.bundle_adjustment
    mapper.global_positioning.use_gpu = adjustment.ceres.use_gpu = False
    adjustment.refine_focal_length = adjustment.refine_extra_params = not is_known
    own, work = database.with_name("global.db"), database.with_name("global")
    shutil.copy(database, own)
    work.mkdir()
    return largest_first(colmap.global_mapping(own, work, work, options))


def _with_camera_of(
    model: Any,
    database: Path,
    count: int,
    seed: int,
    threads: int,
    progress: Callable[[float], None],
) -> list[Any]:
    colmap = load_colmap()
    own = database.with_name("again.db")
    shutil.copy(database, own)
    opened = colmap.Database.open(own)
    try:
        for number in model.cameras:
            camera = opened.read_camera(number)
            camera.params = model.cameras[number].params
            camera.has_prior_focal_length = True
            opened.update_camera(camera)
        opened.clear_two_view_geometries()
    finally:
        opened.close()
    verification = colmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    colmap.geometric_verification(own, two_view_geometry_options=verification)
    known = list(model.cameras)
    return put_together(own, own.with_name("again"), count, known, seed, threads, progress)
