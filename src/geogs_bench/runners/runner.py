"""Runs tasks like ``geogs run`` and ``geogs reconstruct``, with the same options."""

from dataclasses import asdict, replace
from typing import cast

from geogs.application.interrupt import Interruption
from geogs.application.progress.terminal_progress import TerminalProgress
from geogs.application.run_settings import ReconstructSettings, RunSettings
from geogs.cli import reconstruct as reconstruct_command
from geogs.cli import run as run_command
from geogs.cli.options import record
from geogs_bench.runners.colour_baseline import require_packages, train_baseline
from geogs_bench.runners.task import Task

_NO_SETTINGS = ("source", "output", "resume", "checkpoint_every")
"""Settings that do not change a result."""


class Runner:
    """Runs tasks with the code of the two commands, a part of it, or the baseline."""

    def settings(self, task: Task) -> dict[str, object]:
        """Every setting of the command but its output.

        Raises:
            InputError: an option is wrong, or a package of the baseline is not installed.
        """
        if task.command == "colour-2dgs":
            require_packages()
        settings = asdict(settings_of(task))
        settings |= settings.pop("config")
        return {name: value for name, value in settings.items() if name not in _NO_SETTINGS}

    def run(self, task: Task) -> None:
        """Run the command, or its tracking alone; correct one map, saved at the end of the stream,
        by the rule in the options; or train the baseline.

        Raises:
            GeogsError: it failed, with a message.
        """
        from geogs.application.reconstruct import reconstruct_to_folder
        from geogs.application.run import run
        from geogs_bench.runners.saved_map import correct_saved_map
        from geogs_bench.runners.tracking_only import track_to_folder

        settings = replace(settings_of(task), checkpoint_every=0.0)
        if isinstance(settings, RunSettings) and task.command == "track":
            track_to_folder(settings, task.output)
            return
        with TerminalProgress() as progress:
            if task.command == "colour-2dgs":
                train_baseline(cast(ReconstructSettings, settings))
            elif not isinstance(settings, RunSettings):
                reconstruct_to_folder(settings, progress, Interruption())
            elif task.command == "update":
                correct_saved_map(settings, task.output, progress)
            else:
                run(settings, progress, Interruption())


def settings_of(task: Task) -> RunSettings | ReconstructSettings:
    """Settings from a task's options, by the command's own parser."""
    argv = [str(task.source), "-o", str(task.output)]
    argv += [argument for option in task.options for argument in option.arguments()]
    if task.command in ("run", "track", "update"):
        return record(RunSettings, run_command.parse(argv))
    return record(ReconstructSettings, reconstruct_command.parse(argv))
