"""A cluster of Ray, found or started, and the resources of one source."""

import os
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

from geogs.errors import InputError
from geogs.extras import install_command
from geogs.version import __version__
from geogs_fleet.fleet_options import FleetOptions

_OBJECTS = 80 << 20
"""Bytes of the object store of a local cluster; rows are small."""
ASKS_FOR_TOKEN = 2, 59
"""First version of Ray with which a cluster started here requires a token; its ports are open to
the network, whatever its address."""
_PASSING = "geogs: ends with its command"
"""Resource that marks a cluster that ends with its command, so that no other command on this
machine uses it."""


@dataclass(frozen=True)
class Allocation:
    """Resources of a node for one source."""

    cpus: int
    gpus: float
    memory: int | None = None
    """Memory by which Ray schedules tasks, bytes."""
    at_once: int = 1
    """Number of sources that the cluster, as it is now, can compute at a time."""


@contextmanager
def ray_cluster(address: str) -> Iterator[Any]:
    """Context with a connection to a running cluster, or to one started here and ended afterwards.

    Yields the module ``ray``. An existing connection is used, and kept.

    Raises:
        InputError: Ray is not installed, or the cluster cannot be reached.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is reported to anybody
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    try:
        import ray
    except ImportError:
        raise InputError(f"geogs fleet needs Ray: {install_command('fleet')}") from None
    if ray.is_initialized():
        yield ray
        return
    _connect(ray, address)
    try:
        yield ray
    finally:
        ray.shutdown()


def allocation_for(ray: Any, settings: FleetOptions) -> Allocation:
    """Allocation of each source; the settings that are open are chosen by the nodes.

    Raises:
        InputError: no node has the requested resources.
    """
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    most_gpus = max((node.get("GPU", 0.0) for node in nodes), default=0.0)
    gpus = settings.gpus if settings.gpus != "auto" else float(min(most_gpus, 1.0))
    cpus = 1
    if settings.cpus != "auto":
        cpus = settings.cpus
    elif gpus:
        parts = [n.get("CPU", 0.0) * gpus / n["GPU"] for n in nodes if n.get("GPU", 0.0)]
        cpus = max(1, min(16, int(min(parts, default=1.0))))
    memory = settings.memory_limit
    memory_bytes = None if memory is None else int(memory * 2**30)
    wanted = {"CPU": float(cpus), "GPU": gpus, "memory": float(memory_bytes or 0)}
    at_once = sum(_times(node, wanted) for node in nodes)
    if not at_once:
        memory_said = f", {memory:.3g} GiB" if memory is not None else ""
        raise InputError(
            f"No machine of the cluster has {cpus} cores, {gpus:g} GPUs{memory_said} for a "
            "source; ask for less (--cpus, --gpus, --memory-limit)."
        )
    return Allocation(cpus, gpus, memory_bytes, at_once)


def as_task(
    ray: Any, function: Callable[..., Any], allocation: Allocation, retries: int = 0
) -> Callable[..., Any]:
    """Make a function a task of Ray with these resources; a call returns Ray's reference.

    Ray repeats it up to ``retries`` times if its node or its process is lost. A node with another
    version of geogs refuses: the task raises InputError.
    """
    checked = ray.remote(in_version).options(
        num_cpus=allocation.cpus,
        num_gpus=allocation.gpus or None,
        memory=allocation.memory,
        max_retries=retries,
        scheduling_strategy="SPREAD",
    )
    return partial(checked.remote, __version__, function)


def in_version(version: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function. Raises InputError if another version of geogs is installed."""
    if __version__ != version:
        raise InputError(
            f"The machine {platform.node()} has geogs {__version__}, and the fleet is of "
            f"{version}; install the same everywhere."
        )
    return function(*arguments)


def _times(node: dict[str, float], wanted: dict[str, float]) -> int:
    """Number of times that a node has the wanted resources."""
    return min(
        int(node.get(name, 0.0) / amount + 1e-9) for name, amount in wanted.items() if amount
    )


def _connect(ray: Any, address: str) -> None:
    import logging

    from geogs.threads import available_cores

    quiet = {"logging_level": logging.ERROR, "log_to_driver": False}
    if address != "local":
        try:
            ray.init(address=address, **quiet)
            if address != "auto" or _PASSING not in ray.cluster_resources():
                return
            ray.shutdown()
        except ConnectionError as error:
            if address != "auto":
                raise InputError(f"No Ray cluster answers at {address}.") from error
        except (ValueError, RuntimeError, OSError) as error:
            said = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise InputError(f"Ray cannot be reached at {address} ({said}).") from error
    if tuple(int(part) for part in ray.__version__.split(".")[:2]) < ASKS_FOR_TOKEN:
        raise InputError(
            f"Ray {ray.__version__} would start a cluster that anybody on the network can use; "
            f"{install_command('fleet')} --upgrade"
        )
    ray.init(
        address="local",
        num_cpus=available_cores(),  # Ray would count those that others have, too
        include_dashboard=False,
        object_store_memory=_OBJECTS,
        resources={_PASSING: 1},
        **quiet,
    )
