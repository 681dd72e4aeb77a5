"""``geogs fleet run`` and ``geogs fleet join``: many videos, each alone or joined, on Ray."""

import time
from collections.abc import Sequence
from typing import TypeVar, cast

from geogs.cli.options import Given, parse_options
from geogs.config import Preset, preset
from geogs.errors import InputError
from geogs.guard.terminal_text import say
from geogs_fleet.fleet_options import FleetOptions, JoinOptions

Options = TypeVar("Options", bound=FleetOptions)
EXIT_FAILED = 1
"""Exit code if all sources were tried, and one failed."""


def main(argv: Sequence[str]) -> int:
    """Run the command; return 0, or 1 if a source failed or a part could not be joined."""
    words = list(argv)
    if words and words[0] == "join":
        return _join(words[1:])
    if words and not words[0].startswith("-"):
        if words[0] != "run":
            raise InputError(
                f"geogs fleet cannot {words[0]}; it can run: geogs fleet run SOURCES, and join: "
                "geogs fleet join PARTS."
            )
        words = words[1:]
    options = parse(words)
    config_on_gpu = parse(words, on_gpu=True).config

    from geogs_fleet.fleet_progress import TerminalFleet, closing_message
    from geogs_fleet.fleet_run import run_fleet

    begin = time.perf_counter()
    result = run_fleet(options, TerminalFleet(options.quiet), config_on_gpu=config_on_gpu)
    seconds = time.perf_counter() - begin
    if not options.quiet:
        say(*closing_message(result.rows, result.computed, result.output, seconds))
    return EXIT_FAILED if any(row.state != "done" for row in result.rows) else 0


def _join(words: Sequence[str]) -> int:
    options = _parsed(JoinOptions, words, "fleet join")
    config_on_gpu = _parsed(JoinOptions, words, "fleet join", on_gpu=True).config

    from geogs_fleet.fleet_progress import TerminalFleet
    from geogs_fleet.join_run import run_join

    progress = TerminalFleet(options.quiet)
    joint = run_join(options, progress, progress.say, config_on_gpu)
    if not options.quiet:
        say(joint.sentence, f"Open {joint.output}/report/index.html in a browser.")
    return EXIT_FAILED if joint.unjoined else 0


def parse(argv: Sequence[str], on_gpu: bool = False) -> FleetOptions:
    """Parse options, over those of a preset for the CPU or for a GPU.

    Raises:
        SystemExit: after ``--help``.
        InputError: an option is wrong or missing.
    """
    return _parsed(FleetOptions, argv, "fleet run", on_gpu)


def _parsed(
    kind: type[Options], argv: Sequence[str], command: str, on_gpu: bool = False
) -> Options:
    def defaults(given: Given) -> Options:
        name = cast(Preset, given.get("preset", "default"))
        return kind(config=preset(name, on_gpu), preset=name)

    return parse_options(kind, argv, command, defaults)
