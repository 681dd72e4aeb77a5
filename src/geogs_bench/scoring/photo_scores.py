"""Agreement of held-out images across a mesh, where there is no true surface."""

from pathlib import Path

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.evaluation.surfaces.photoconsistency import evaluate_photoconsistency
from geogs.evaluation.true_scene import photographs
from geogs.io.sources.posed.posed_source import PosedSource
from geogs.io.sources.sniff import open_posed_source
from geogs_bench.data.benchmark_scene import BenchmarkScene
from geogs_bench.results.record import PhotoScore
from geogs_bench.results.result_folder import ResultFolder

_LONG_EDGE = 800


def score_photo(scene: BenchmarkScene, result: ResultFolder) -> PhotoScore:
    """Measured in the images that the run did not use (``held_out`` of its summary).

    Raises:
        InputError: the run used all images, or left no mesh, or no two views can be compared.
    """
    mesh = result.mesh("final")
    if mesh is None or not mesh.is_mesh:
        raise InputError(f"{result.path} holds no mesh to score.")
    source = open_posed_source(scene.source, InputConfig(long_edge=_LONG_EDGE))
    held_out = _indices(source, result.summary.get("held_out", []))
    if not held_out:
        raise InputError(
            f"{scene.name} has no true surface, and the run held no image out by which to judge it."
        )
    found = evaluate_photoconsistency(mesh, source.camera, photographs(source), held_out)
    return PhotoScore(
        found.score, found.ncc_mean, found.ncc_median, found.coverage, found.views, found.window
    )


def _indices(source: PosedSource, listed: list[int | str]) -> list[int]:
    """Places in the source of images that are listed by place or by file name."""
    names = {Path(source.label(i)).name: i for i in range(len(source))}
    found = [i if isinstance(i, int) else names.get(Path(i).name) for i in listed]
    return [i for i in found if i is not None and i < len(source)]
