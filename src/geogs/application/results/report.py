"""``report/``: a page with what needs no ground truth."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from geogs.application.results.shown_model import ShownView, shown_model
from geogs.mesh.types import Mesh
from geogs.types import MapSnapshot, RenderedKeyframe, Trajectory


def write_report(
    folder: Path,
    trajectory: Trajectory,
    renders: Sequence[RenderedKeyframe],
    mesh: Mesh | None,
    summary: Mapping[str, object],
    disks: MapSnapshot | None = None,
) -> None:
    """A model that turns, the path, renders beside images, and the numbers of the summary.

    Raises:
        OutputError: a file cannot be written.
    """
    from geogs.evaluation import run_pictures
    from geogs.evaluation.run_report import write_run_page

    folder.mkdir(exist_ok=True)
    run_pictures.draw_path(folder / "trajectory.png", trajectory)
    if renders:
        numbers = np.linspace(0, len(renders) - 1, min(5, len(renders))).round().astype(int)
        shown = [renders[i] for i in numbers]
        run_pictures.draw_keyframes(
            folder / "keyframes.png",
            [r.image for r in shown if r.image is not None],
            [r.depth.cpu().numpy() for r in shown],
            [r.normal.cpu().numpy() for r in shown],
        )
    model = None
    if renders:
        keyframes, camera = shown_views(renders), renders[0].camera
        model = shown_model(trajectory, keyframes, camera, mesh, disks)
    write_run_page(folder, summary, model)


def shown_views(renders: Sequence[RenderedKeyframe]) -> list[ShownView]:
    """The keyframes of the page; those of a long video stay where they are until they are shown."""

    def image(number: int) -> UInt8[np.ndarray, "h w 3"] | None:
        return renders[number].image

    return [
        ShownView(r.timestamp, np.linalg.inv(r.T_cw.cpu().numpy()), partial(image, i))
        for i, r in enumerate(renders)
    ]
