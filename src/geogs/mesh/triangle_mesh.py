"""The records of mesh extraction: its input and output."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, Int32, UInt8
from torch import Tensor

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.geometry.creases import creased
from geogs.guard.documents import expanded
from geogs.mesh.tensor_mesh import TensorMesh

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True, slots=True)
class DepthMapView:
    """One depth map with its pose, as rendered from the map."""

    depth: Float[Tensor, "h w"]
    """z in map units; zero, negative or not finite where unknown."""
    weight: Float[Tensor, "h w"]
    """Confidence, at least 0; 0 leaves the pixel out."""
    camera: Camera
    """Camera of the depth map."""
    T_cw: Float[Tensor, "4 4"]
    """World to camera, float64."""
    image: UInt8[np.ndarray, "ih iw 3"] | None = None
    """RGB of the same view, of any size; gives the vertices their colour."""

    def rgb(self) -> UInt8[np.ndarray, "ih iw 3"]:
        """The image, which must exist."""
        assert self.image is not None, "a view without an image shows no colours"
        return self.image

    def valid(self) -> torch.Tensor:
        """Pixels (h, w) that carry a depth."""
        return torch.isfinite(self.depth) & (self.depth > 0) & (self.weight > 0)


@dataclass(frozen=True, slots=True, repr=False)
class Mesh:
    """Triangles in the world frame; faces turn counter-clockwise seen from free space."""

    vertices: Float[np.ndarray, "n 3"]
    """float32, map units."""
    faces: Int32[np.ndarray, "m 3"]
    normals: Float[np.ndarray, "n 3"]
    """float32, unit, towards free space."""
    colours: UInt8[np.ndarray, "n 3"] | None = None
    """RGB."""

    def __repr__(self) -> str:
        colours = "without colours" if self.colours is None else "with colours"
        return f"Mesh({len(self.vertices)} vertices, {len(self.faces)} triangles, {colours})"

    @staticmethod
    def from_triangles(vertices: Float[np.ndarray, "n 3"], faces: np.ndarray) -> "Mesh":
        """A mesh whose normals are computed from its faces."""
        vertices = np.asarray(vertices, np.float32)
        faces = np.asarray(faces, np.int32).reshape(-1, 3)
        return Mesh(vertices, faces, vertex_normals(vertices, faces))

    def rotated(self, R: Float[np.ndarray, "3 3"]) -> "Mesh":
        """The mesh in a world that ``R`` maps this one to."""
        vertices, normals = ((a @ R.T).astype(np.float32) for a in (self.vertices, self.normals))
        return replace(self, vertices=vertices, normals=normals)

    def creased(self) -> "Mesh":
        """A mesh that looks the same, with vertices of their own on each side of a sharp edge."""
        origin, faces, normals = creased(self.vertices, self.faces)
        colours = None if self.colours is None else self.colours[origin]
        return Mesh(self.vertices[origin], faces, normals, colours)

    def save(self, path: str | Path) -> None:
        """Write a file that ends in .ply, .glb, .obj, .usdz or .stl. In GLB, OBJ and USDZ y is up,
        in STL z, if y is down here; GLB and USDZ, which are for viewing, have a vertex for each
        side of a sharp edge.

        Raises:
            InputError: it ends otherwise.
            OutputError: it cannot be written.
        """
        from geogs.guard.atomic import atomic_file
        from geogs.io.writers.exports.mesh_writers import glb, write_obj, write_stl
        from geogs.io.writers.exports.usdz_writer import write_usdz
        from geogs.io.writers.ply_writer import write_mesh

        path = expanded(path)
        match path.suffix.lower():
            case ".ply":
                write_mesh(path, self.vertices, self.faces, self.colours, self.normals)
            case ".glb":
                mesh = self.creased()
                with atomic_file(path) as stream:
                    stream.write(glb(mesh.vertices, mesh.faces, mesh.normals, mesh.colours))
            case ".obj":
                write_obj(path, self.vertices, self.faces, self.normals, self.colours)
            case ".stl":
                write_stl(path, self.vertices, self.faces)
            case ".usdz":
                mesh = self.creased()
                write_usdz(path, mesh.vertices, mesh.faces, mesh.normals, mesh.colours)
            case _:
                raise InputError(f"{path} should end in .ply, .glb, .obj, .usdz or .stl.")

    def to_trimesh(self) -> "trimesh.Trimesh":
        """The mesh for trimesh. Raises InputError if that is not installed."""
        try:
            import trimesh
        except ImportError:
            raise InputError("trimesh is missing; pip install trimesh brings it.") from None
        return trimesh.Trimesh(
            self.vertices,
            self.faces,
            vertex_normals=self.normals,
            vertex_colors=self.colours,
            process=False,
        )


def vertex_normals(
    vertices: Float[np.ndarray, "n 3"], faces: Int32[np.ndarray, "m 3"]
) -> Float[np.ndarray, "n 3"]:
    """Unit normals, the mean of a vertex's faces weighted by area; zero where it has none."""
    return TensorMesh.of(vertices, faces).normals().numpy()


def median_edge(mesh: Mesh) -> float:
    """Median length of the edges of the faces; zero where there is none."""
    if not len(mesh.faces):
        return 0.0
    corners = mesh.vertices.astype(np.float64)[mesh.faces]
    return float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))
