"""``geogs fleet join``: runs the overlapping parts that have no result yet, then joins all."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from geogs.application.results.output_folder import chosen_folder, claimed
from geogs.cli.options import record
from geogs.config import Config
from geogs.errors import InputError
from geogs.guard.documents import read_json
from geogs_fleet.cluster import allocation_for, ray_cluster
from geogs_fleet.fleet_options import FleetOptions, JoinOptions
from geogs_fleet.fleet_progress import FleetProgress
from geogs_fleet.fleet_run import run_fleet
from geogs_fleet.sources import find_sources
from geogs_fleet.storage import StoragePath
from geogs_fleet.workers import RayWorkers

if TYPE_CHECKING:
    from geogs_fleet.join.join import Joint
    from geogs_fleet.join.part import Part

PARTS = "parts"
"""Folder for the results of parts that are run."""


def run_join(
    settings: JoinOptions,
    progress: FleetProgress | None = None,
    say: Callable[[str], None] = lambda sentence: None,
    config_on_gpu: Config | None = None,
) -> "Joint":
    """Run the parts that are no results yet, and join all of them.

    ``config_on_gpu`` replaces the settings' own ``config`` where there are GPUs.

    Raises:
        InputError: a part is unusable, no two of them overlap, or Ray is missing.
        OutputError: the folder holds a result, which ``settings`` do not let be replaced, or it
            cannot be written.
    """
    path = StoragePath(settings.output).path if settings.output else None
    if path is None:
        raise InputError("The joint result needs a folder that all machines see; give one (-o).")
    place = chosen_folder(path.absolute(), "", settings.overwrite)
    with claimed(place) as output, ray_cluster(settings.address) as ray:
        allocation = allocation_for(ray, settings)
        if allocation.gpus and config_on_gpu is not None:
            settings = replace(settings, config=config_on_gpu)
        parts = _parts(settings, output, progress, say)

        from geogs_fleet.join.join import join_parts

        device = "cuda" if allocation.gpus else "cpu"
        workers = RayWorkers(ray, allocation, settings.attempts, say)
        return join_parts(parts, output, settings.config, workers, device, settings.adjust, say)


def _parts(
    settings: JoinOptions, output: Path, progress: FleetProgress | None, say: Callable[[str], None]
) -> "list[Part]":
    """The results to join, in the order of their names on the command line."""
    from geogs_fleet.join.part import Part

    found: list[Path | str] = []
    for word in settings.source:
        results = finished_results(word)
        found += results or [source.address for source in find_sources([word])]
    videos = list(dict.fromkeys(address for address in found if isinstance(address, str)))
    made: dict[str, Path] = {}
    if videos:
        each = record(FleetOptions, settings)
        each = replace(each, source=tuple(videos), output=str(output / PARTS))
        for row in run_fleet(each, progress).rows:
            if row.state == "done":
                made[row.source] = output / PARTS / row.name
            else:
                say(f"{row.name} is left out: {row.sentence}")
    folders = [made.get(f) if isinstance(f, str) else f for f in dict.fromkeys(found)]
    usable = [f for f in folders if f is not None and (f / "map.safetensors").is_file()]
    if len(usable) < 2:
        raise InputError(
            f"{len(usable)} of {len(folders)} parts have a map; two or more are needed to be "
            "joined."
        )
    return [Part(name, f) for name, f in zip(_names(usable), usable, strict=True)]


def finished_results(word: str) -> list[Path]:
    """Folders of the results that a word names: a result, or those of a fleet; else none."""
    path = StoragePath(word).path
    if path is None or not path.is_dir():
        return []
    if (path / "map.safetensors").is_file():
        return [path.absolute()]
    if not (path / "fleet.json").is_file():
        return []
    table = read_json(path / "fleet.json")
    rows = table.get("sources", []) if isinstance(table, dict) else []
    names = sorted(
        str(row["name"]) for row in rows if isinstance(row, dict) and row.get("state") == "done"
    )
    folders = [(path / Path(name).name).absolute() for name in names]
    return [folder for folder in folders if (folder / "map.safetensors").is_file()]


def _names(folders: list[Path]) -> list[str]:
    """A unique name for each folder."""
    names: list[str] = []
    for folder in folders:
        same = sum(name == folder.name or name.startswith(f"{folder.name}-") for name in names)
        names.append(folder.name if not same else f"{folder.name}-{same + 1}")
    return names
