"""Jobs of a join on a simulated cluster: lost and slow nodes, errors, and the same results."""

import os
import sys
import threading
import time
from argparse import Namespace
from pathlib import Path

import numpy as np
import pytest
import torch

from cluster_nodes import add_node, simulated_cluster
from geogs.config import Config, MeshConfig
from geogs.errors import DeviceError, InputError
from geogs.io.writers.map_file import load_map_file
from geogs.mesh.mesh_file import read_mesh
from geogs_fleet.cluster import Allocation
from geogs_fleet.join.join import join_parts
from geogs_fleet.join.part import Part
from geogs_fleet.workers import RayWorkers
from joined_parts import make_part
from one_process import OneProcess

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'geogs[fleet]'")
pytestmark = [
    pytest.mark.system,
    pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::FutureWarning"),
]


@pytest.fixture(scope="module")
def cluster():
    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])  # nodes cannot import tests
    with simulated_cluster() as made:
        yield made


def squared(number: int) -> int:
    return number * number


def refused(number: int) -> int:
    if number == 3:
        raise InputError("No 3, please.")
    return number


def ends_its_process(number: int) -> int:
    os._exit(1)


def slow_on_its_first_node(place: str, number: int) -> int:
    """Says that it was begun; until somebody else has begun it as well, it never ends."""
    folder = Path(place)
    (folder / f"{number}-{os.getpid()}").touch()
    while number == 0 and len(list(folder.glob("0-*"))) < 2:
        time.sleep(0.05)
    return number + 100


def workers(attempts: int = 3) -> RayWorkers:
    return RayWorkers(ray, Allocation(1, 0.0, None, 2), attempts)


def test_results_are_in_the_order_of_the_jobs_and_errors_are_what_they_were(cluster):
    assert workers().map("counting", squared, [(n,) for n in range(7)]) == [n * n for n in range(7)]
    assert workers().map("counting", squared, []) == []
    with pytest.raises(InputError, match="No 3, please"):
        workers().map("counting", refused, [(n,) for n in range(5)])
    with pytest.raises(DeviceError, match="Counting failed 2 times"):
        workers(2).map("counting", ends_its_process, [(1,)])


def test_a_job_whose_node_is_removed_is_done_elsewhere_and_counts_once(cluster, tmp_path):
    node = add_node(cluster, 1)
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    def remove_when_begun() -> None:
        while not list(tmp_path.glob("0-*")):
            time.sleep(0.05)
        cluster.remove_node(node, allow_graceful=False)

    class FirstOnThatNode:
        """Ray, but tasks go to the node that will be lost, as long as it is there."""

        def __getattr__(self, name):
            return getattr(ray, name)

        def remote(self, function):
            affinity = NodeAffinitySchedulingStrategy(node.node_id, soft=True)
            return Namespace(
                options=lambda **o: ray.remote(function).options(
                    **{**o, "scheduling_strategy": affinity}
                )
            )

    remover = threading.Thread(target=remove_when_begun, daemon=True)
    remover.start()
    lost = RayWorkers(FirstOnThatNode(), Allocation(1, 0.0, None, 2), 3)
    jobs = [(str(tmp_path), n) for n in range(4)]
    assert lost.map("waiting", slow_on_its_first_node, jobs) == [100, 101, 102, 103]
    remover.join(600)
    assert len(list(tmp_path.glob("0-*"))) == 2  # begun twice


def test_a_join_on_a_cluster_is_that_of_one_process(cluster, tmp_path, monkeypatch):
    # Takes half of the time.
    monkeypatch.setattr("geogs_fleet.join.join.write_pictures", lambda *a: None)
    monkeypatch.setattr("geogs_fleet.join.join.write_page", lambda *a: None)
    places = np.linspace(-0.2, 0.0, 3), np.linspace(-0.15, 0.05, 3)
    config = Config(mesh=MeshConfig(voxel=0.08, min_component_faces=10))
    parts = [Part(n, make_part(tmp_path / n, p, k)) for k, (n, p) in enumerate(zip("ab", places))]  # noqa: B905
    join_parts(parts, tmp_path / "one", config, OneProcess(), adjust=False)
    join_parts(parts, tmp_path / "many", config, workers(), adjust=False)
    for name in ("trajectory.tum", "keyframes.tum"):
        one, many = ((tmp_path / out / name).read_bytes() for out in ("one", "many"))
        assert one == many, name
    one, many = (load_map_file(tmp_path / out / "map.safetensors") for out in ("one", "many"))
    assert torch.equal(one.disks.position, many.disks.position)
    assert torch.equal(one.disks.scale, many.disks.scale)
    assert torch.equal(one.tensors["keyframe_T_cw"], many.tensors["keyframe_T_cw"])
    one, many = (read_mesh(tmp_path / out / "mesh.ply") for out in ("one", "many"))
    assert np.array_equal(one.vertices, many.vertices)
    assert np.array_equal(one.faces, many.faces)
