"""Renders of the joint map from every keyframe, in files, so that each is rendered once."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from geogs.application.results.saved_result import load_result
from geogs.documents import open_file
from geogs.geometry.camera import Camera
from geogs.io.writers.keyframe_folder import image_path, read_image
from geogs.mesh.triangle_mesh import DepthMapView
from geogs.on_demand import OnDemand


@dataclass(frozen=True)
class StoredView:
    """A depth map in a file."""

    file: Path
    image: Path
    camera: Camera
    T_cw: Float64[np.ndarray, "4 4"]

    def load(self, with_image: bool = False) -> DepthMapView:
        """Load the depth map, and the image if requested."""
        with open_file(self.file) as stored, np.load(stored, allow_pickle=False) as file:
            depth, weight = torch.from_numpy(file["depth"]), torch.from_numpy(file["weight"])
        image = read_image(self.image) if with_image else None
        return DepthMapView(depth, weight.float(), self.camera, self.pose, image)

    @property
    def pose(self) -> Float[Tensor, "4 4"]:
        """World to camera; a copy, as Ray's arrays are read-only."""
        return torch.tensor(self.T_cw)


def loaded(views: Sequence[StoredView], with_images: bool = False) -> Sequence[DepthMapView]:
    """Sequence of views, each loaded on demand."""
    return OnDemand(views, lambda view: view.load(with_images))


def render_views(
    written: Path, places: Sequence[int], folder: Path, device: str = "cpu"
) -> list[StoredView]:
    """Render some keyframes of a written result into files of a folder."""
    result, made = load_result(written, device), []
    for n in places:
        T_cw = result.views.T_cw[n]
        maps = result.renderer.surface(torch.from_numpy(T_cw))
        file = folder / f"{n:06d}.npz"
        # The weights 0, a half and 1 are exact in half precision.
        np.savez(file, depth=maps.depth.cpu().numpy(), weight=maps.weight.cpu().half().numpy())
        image = image_path(written, int(result.views.keyframe_id[n]))
        made.append(StoredView(file, image, result.depth_camera, T_cw))
    return made


def equal_runs(count: int, parts: int) -> list[tuple[int, ...]]:
    """Split the numbers below ``count`` into ``parts`` runs of about equal length, none empty."""
    ends = np.linspace(0, count, min(max(parts, 1), max(count, 1)) + 1).round().astype(int)
    return [tuple(range(a, b)) for a, b in pairwise(ends) if b > a]
