"""Runs tasks as ``geogs run`` and ``geogs reconstruct`` would, by the same options."""

from dataclasses import asdict, replace

from geogs.application.interrupt import Interruption
from geogs.application.run_settings import ReconstructSettings, RunSettings
from geogs.application.terminal_progress import TerminalProgress
from geogs.cli import reconstruct as reconstruct_command
from geogs.cli import run as run_command
from geogs.cli.options import record
from geogs_bench.runners.runner import Command, Runner, Task

_NO_SETTINGS = ("source", "output", "resume", "checkpoint_every")
"""What changes nothing about a result."""


class CommandRunner:
    """Runs tasks by what is behind the two commands."""

    def settings(self, task: Task) -> dict[str, object]:
        """Every setting of the command but its output. Raises InputError for a wrong option."""
        settings = asdict(settings_of(task))
        settings |= settings.pop("config")
        return {name: value for name, value in settings.items() if name not in _NO_SETTINGS}

    def run(self, task: Task) -> None:
        """Run the command."""
        from geogs.application.reconstruct import reconstruct_to_folder
        from geogs.application.run import run

        settings = replace(settings_of(task), checkpoint_every=0.0)
        with TerminalProgress() as progress:
            if isinstance(settings, RunSettings):
                run(settings, progress, Interruption())
            else:
                reconstruct_to_folder(settings, progress, Interruption())


class TrackingRunner(CommandRunner):
    """What ``geogs run`` does but for the map; the options are the same."""

    def run(self, task: Task) -> None:
        """Track, and write the trajectory."""
        from geogs_bench.runners.tracking_only import track_to_folder

        settings = settings_of(task)
        assert isinstance(settings, RunSettings)
        track_to_folder(settings, task.output)


class UpdateRunner(CommandRunner):
    """Moves one map, as the stream has left it, by the rule that the options name."""

    def run(self, task: Task) -> None:
        """Run the stream unless its map is kept, correct that, and write the result."""
        from geogs_bench.runners.saved_map import correct_saved_map

        settings = settings_of(task)
        assert isinstance(settings, RunSettings)
        with TerminalProgress() as progress:
            correct_saved_map(settings, task.output, progress)


def runners() -> dict[Command, Runner]:
    """Who runs which command."""
    from geogs_bench.runners.colour_baseline import BaselineRunner

    command = CommandRunner()
    return {
        "run": command,
        "track": TrackingRunner(),
        "update": UpdateRunner(),
        "reconstruct": command,
        "colour-2dgs": BaselineRunner(),
    }


def settings_of(task: Task) -> RunSettings | ReconstructSettings:
    """What a task's options say, by the command's own parser."""
    argv = [str(task.source), "-o", str(task.output)]
    argv += [argument for option in task.options for argument in option.arguments()]
    if task.command in ("run", "track", "update"):
        return record(RunSettings, run_command.parse(argv))
    return record(ReconstructSettings, reconstruct_command.parse(argv))
