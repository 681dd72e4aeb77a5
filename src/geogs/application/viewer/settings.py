"""Settings of the viewers."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from geogs.config.setting import Basic, Positional, Range, Settings

HERE = "127.0.0.1"
"""Address that only this machine sees."""
Port = Annotated[int, Range(1, 65535)]


@dataclass(frozen=True)
class ViewSettings(Settings):
    """Look at a result in the browser: mesh, disks, path, keyframes with depth and normals.

    Needs pip install 'geogs[viewer]'; without it, open report/index.html of the result. Over ssh:
    ssh -L 8080:localhost:8080 MACHINE, then http://localhost:8080 on your own machine.
    """

    result: Annotated[Path, Positional()]
    """Folder of a result, as geogs run and geogs reconstruct write it."""
    port: Annotated[Port, Basic("-p")] = 8080
    """Where the page is served; if it is taken, the next that is free."""
    host: str = HERE
    """Address at which it is served; 0.0.0.0 lets other machines look, too."""


@dataclass(frozen=True)
class LiveSettings(Settings):
    """Settings of a viewer of a run."""

    viewer: bool = False
    """Show the run in the browser while it goes on; needs pip install 'geogs[viewer]'."""
    viewer_port: Port = 8080
    """Where that page is served, to this machine alone; if it is taken, the next that is free."""
    record: Path | None = None
    """Also record the run in this file, .rrd, for the rerun viewer; needs pip install
    'geogs[record]'."""
