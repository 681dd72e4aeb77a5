"""The program without a command line: run, reconstruct, write results, resume, evaluate."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from geogs.application.calibrate import self_calibrated
    from geogs.application.progress.run_progress import RunProgress
    from geogs.application.results.result import Result
    from geogs.application.results.write import write_results

__all__ = ["Result", "RunProgress", "self_calibrated", "write_results"]

_HOMES = {
    "Result": "geogs.application.results.result",
    "RunProgress": "geogs.application.progress.run_progress",
    "self_calibrated": "geogs.application.calibrate",
    "write_results": "geogs.application.results.write",
}


def __getattr__(name: str) -> Any:
    """Import the public names when they are first used, so that the command line starts at once."""
    if name not in _HOMES:
        raise AttributeError(f"module geogs.application has no attribute {name}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
