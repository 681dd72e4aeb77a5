"""Writing of all files of a run or a reconstruction to its folder."""

import json
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from geogs.application.results.keyframe_files import write_keyframes
from geogs.application.results.output_folder import chosen_folder, claimed, is_complete
from geogs.application.results.result import Result
from geogs.application.results.result_page import write_page, write_pictures
from geogs.application.results.summary import source_summary, statistics, summarise
from geogs.application.results.surfaces import fusion_views, splat_colours
from geogs.application.settings_file import settings_text
from geogs.config import Config, ReconstructConfig
from geogs.errors import OutputError
from geogs.evaluation.pages.run_page import lengths
from geogs.guard.atomic import write_text
from geogs.guard.replacement import replaced
from geogs.io.sources.posed.posed_source import PosedSource
from geogs.io.writers.intrinsics_file import write_intrinsics
from geogs.io.writers.map_file import save_map_with_views
from geogs.io.writers.ply_writer import write_splats
from geogs.io.writers.trajectories import write_trajectories
from geogs.io.writers.uncertainty import write_uncertainty
from geogs.threads import on_one_torch_thread
from geogs.types import RenderedKeyframe


def write_results(
    output: str | Path, result: Result, keyframe_images: bool = True, overwrite: bool = False
) -> None:
    """Write all files of a result into a folder; an earlier one of the same source is replaced.

    If a file cannot be written, the earlier result stays.

    Args:
        output: folder of the result.
        result: the result.
        keyframe_images: whether the images of the keyframes are written, too.
        overwrite: whether the result of another source, or an unfinished run, may be replaced.

    Raises:
        OutputError: the folder holds a result that may not be replaced, as a complete one by one
            that is not, or a file cannot be written.
    """
    wanted = Path(output)
    chosen_folder(wanted, "", overwrite, result.progress, result.source.fingerprint)
    with claimed(wanted) as folder, replaced(folder, "result") as new:
        write_files(new, result, keyframe_images=keyframe_images)
        if is_complete(folder) and not is_complete(new):
            raise OutputError(
                f"{wanted} holds a complete result, and this one is incomplete; give another "
                "folder."
            )


@on_one_torch_thread
def write_files(
    output: Path,
    result: Result,
    write_more: Callable[[], None] = lambda: None,
    keyframe_images: bool = True,
) -> None:
    """Write poses first, then map, pictures and mesh in parallel, other requested files, and the
    page, which shows all of them.

    ``write_more`` writes the other files, before the summary.

    Raises:
        OutputError: a file cannot be written.
    """
    scene = result.scene
    source = result.source
    progress = result.progress
    write_trajectories(output, result.trajectory, result.keyframes)
    if result.uncertainty is not None:
        table = output / "trajectory_uncertainty.csv"
        write_uncertainty(table, result.trajectory, result.uncertainty)
    as_it_came = () if isinstance(source, PosedSource) else (source.calibration, source.shutter)
    write_intrinsics(output / "intrinsics.json", source.camera, *as_it_came)
    write_config(output / "config.yaml", scene.config)
    disks = result.map
    shown = result.renders
    renders = shown if result.why_no_map is None else ()
    with ThreadPoolExecutor(2, thread_name_prefix="files") as threads:
        written = threads.submit(_write_map, output, result, renders, keyframe_images)
        drawn = threads.submit(_write_pictures, output, result, shown)
        if (mesh := result.mesh) is not None:
            with scene.stopwatch("mesh"):
                mesh.save(output / "mesh.ply")
        with scene.stopwatch("keyframes"):
            written.result()
            drawn.result()
    write_more()
    lost = result.trajectory.states.count("lost")
    if lost > 0.2 * scene.frames:
        progress.write(f"warning: {lost} of {scene.frames} frames were not tracked.")
    summary = summarise(result)
    write_text(output / "summary.json", json.dumps(summary, indent=2))
    progress.stage("report", 0.0)
    with scene.stopwatch("report"):
        write_page(output / "report", result.trajectory, shown, mesh, summary, disks)
    progress.stage("report", 1.0)


@on_one_torch_thread
def _write_map(
    output: Path, result: Result, renders: Sequence[RenderedKeyframe], keyframe_images: bool
) -> None:
    """Write keyframes, map and splats, in parallel to the mesh."""
    scene = result.scene
    source = result.source
    disks = result.map
    with scene.stopwatch.aside():
        if result.why_no_map is None:
            views = write_keyframes(output, scene, source.camera, renders, keyframe_images)
            metadata = {"source": source.name, "seed": scene.config.seed}
            save_map_with_views(output / "map.safetensors", views, metadata)
        if len(disks):
            colours = splat_colours(disks, fusion_views(renders))
            write_splats(output / "splats.ply", disks, colours)


@on_one_torch_thread
def _write_pictures(output: Path, result: Result, shown: Sequence[RenderedKeyframe]) -> None:
    """Draw the pictures of the report, in parallel to the mesh."""
    with result.scene.stopwatch.aside():
        scale = {**source_summary(result.source), **statistics(result.scene)}
        write_pictures(output / "report", shown, lengths(scale).name)


def write_config(path: Path, config: Config | ReconstructConfig) -> None:
    """Write all settings as YAML, which ``--config`` takes."""
    write_text(path, settings_text(config))
