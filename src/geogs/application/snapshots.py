"""The map as it stood after some seconds: kept while it trains, written at the end."""

from collections.abc import Sequence
from pathlib import Path

from geogs.application.progress import RunProgress
from geogs.application.results.surfaces import write_surface
from geogs.io.writers.native import save_map
from geogs.reconstruction import Reconstruction
from geogs.types import MapSnapshot


class Snapshots:
    """Copies of the disks at the first report of progress after each of some seconds.

    They count from the moment when the images have been read. Nothing is written meanwhile.
    """

    def __init__(self, seconds: Sequence[float]) -> None:
        self._due = sorted(set(seconds))
        self._kept: dict[float, MapSnapshot] = {}
        self._early: list[float] = []

    def take(self, scene: Reconstruction) -> None:
        """Copy the disks if the time for it has come; where there are none yet there is no copy."""
        while self._due and scene.elapsed >= self._due[0]:
            disks, seconds = scene.snapshot(), self._due.pop(0)
            if len(disks):
                self._kept[seconds] = disks
            else:
                self._early.append(seconds)

    def write(self, output: Path, scene: Reconstruction, progress: RunProgress) -> None:
        """``snapshots/<seconds>/{map.safetensors, mesh.ply}`` for each copy.

        Raises:
            OutputError: a file cannot be written.
        """
        for seconds in self._early:
            progress.write(f"No snapshot after {seconds:g} s: there was no map yet.")
        for seconds, disks in self._kept.items():
            folder = output / "snapshots" / f"{seconds:g}"
            with scene.stopwatch("snapshots"):
                save_map(folder / "map.safetensors", disks, {"seconds": seconds})
                name = f"mesh at {seconds:g} s"
                renders = scene.renders(disks)
                write_surface(folder / "mesh.ply", renders, scene.config.mesh, progress, name)
