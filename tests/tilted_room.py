"""A result whose mesh is a box, rough and tilted, seen from inside by tilted cameras."""

import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from box_room import box, circle
from geogs.io.writers.trajectories import write_tum_trajectory
from geogs.mesh.triangle_mesh import Mesh
from geogs.types import Trajectory
from saved_results import make_result


def make_room(folder: Path, turn: Rotation, noise: float = 0.004, scale: str = "metric") -> Path:
    """A result in a turned world, whose own up is z: a box of 6 x 4 x 2.4 with some noise."""
    make_result(folder)
    vertices, faces = box((3.0, 2.0, 1.2))
    for _ in range(6):  # each triangle becomes four
        corners = vertices[faces]
        a, b, c = corners.transpose(1, 0, 2)
        d, e, f = ((corners + np.roll(corners, -1, 1)) / 2).transpose(1, 0, 2)
        vertices = np.stack([a, d, f, d, b, e, f, e, c, d, e, f], 1).reshape(-1, 3)
        vertices, back = np.unique(vertices.round(9), axis=0, return_inverse=True)
        faces = back.reshape(-1, 3)
    vertices += np.random.default_rng(0).normal(0, noise, vertices.shape)
    mesh = Mesh.from_triangles(turn.apply(vertices), faces)
    if ((mesh.normals * mesh.vertices).sum(1)).mean() > 0:  # towards free space: inwards
        mesh = Mesh.from_triangles(mesh.vertices, faces[:, ::-1])
    mesh.save(folder / "mesh.ply")
    T_wc = circle()
    nod = Rotation.from_euler("xz", [-20, 8], degrees=True).as_matrix()
    T_wc[:, :3, :3] = turn.as_matrix() @ T_wc[:, :3, :3] @ nod
    T_wc[:, :3, 3] = turn.apply(T_wc[:, :3, 3])
    path = Trajectory(np.arange(len(T_wc)) / 30, T_wc, np.ones(len(T_wc), bool))
    write_tum_trajectory(folder / "trajectory.tum", path)
    said = {"scale": f"{scale} (a tag)" if scale == "metric" else scale}
    (folder / "summary.json").write_text(json.dumps(said))
    return folder
