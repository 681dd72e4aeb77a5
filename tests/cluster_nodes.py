"""Simulated clusters: several nodes of Ray in this machine."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

OBJECTS = 80 << 20
"""Bytes of a node's object store."""


@contextmanager
def simulated_cluster(cpus: int = 2, **head: Any) -> Iterator[Any]:
    """A head with so many cores, connected to; nodes can be added and removed.

    Whatever happens inside, nothing of it runs afterwards.
    """
    import ray
    from ray.cluster_utils import Cluster

    ray.shutdown()  # of a test before, if it was broken off
    made = Cluster(
        initialize_head=True,
        head_node_args={
            "num_cpus": cpus, "object_store_memory": OBJECTS, "include_dashboard": False, **head,
        },
    )  # fmt: skip
    try:
        ray.init(address=made.address, log_to_driver=False, logging_level="ERROR")
        yield made
    finally:
        ray.shutdown()
        made.shutdown()


def add_node(cluster: Any, cpus: int = 2, **more: Any) -> Any:
    """One more node."""
    return cluster.add_node(num_cpus=cpus, object_store_memory=OBJECTS, **more)
