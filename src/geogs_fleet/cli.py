"""``geogs fleet run`` and ``geogs fleet join``: many videos, one by one or to one place, on Ray."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, cast

from geogs.cli.options import Given, parse_options, record
from geogs.config import Preset, preset
from geogs.config.setting import Basic
from geogs.errors import InputError
from geogs_fleet.join_run import JoinSettings
from geogs_fleet.settings import FleetSettings

EXIT_FAILED = 1
"""Exit code where all has been tried, and a source failed."""


@dataclass(frozen=True)
class FleetOptions(FleetSettings):
    """Reconstruct many videos, each on its own, on one machine or many: geogs fleet run clips/.

    Needs pip install 'geogs[fleet]' (Ray) on every machine. Started again, it does what is missing,
    and goes on from the checkpoints of what was under way.
    """

    preset: Preset = "default"
    """Group of settings; single ones given beside it win."""
    quiet: Annotated[bool, Basic("-q")] = False
    """Say nothing but errors."""


@dataclass(frozen=True)
class JoinOptions(JoinSettings):
    """Make one place of many videos that overlap: geogs fleet join a.mp4 b.mp4 c.mp4.

    Each is run by itself, on one machine or many; where keyframes of two show the same, they are
    joined. Needs pip install 'geogs[fleet]' (Ray) on every machine.
    """

    preset: Preset = "default"
    """Group of settings; single ones given beside it win."""
    quiet: Annotated[bool, Basic("-q")] = False
    """Say nothing but errors."""


def main(argv: Sequence[str]) -> int:
    """Run the command; returns 0, or 1 where a source failed or a part could not be joined."""
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

    from geogs_fleet.run import run_fleet
    from geogs_fleet.terminal import TerminalFleet, closing_message

    begin = time.perf_counter()
    settings = record(FleetSettings, options)
    result = run_fleet(settings, TerminalFleet(options.quiet))
    seconds = time.perf_counter() - begin
    if not options.quiet:
        print(closing_message(result.rows, result.computed, result.output, seconds))
    return EXIT_FAILED if any(row.state != "done" for row in result.rows) else 0


def _join(words: Sequence[str]) -> int:
    options = parse_options(JoinOptions, words, "fleet join", _join_defaults)

    from geogs_fleet.join_run import run_join
    from geogs_fleet.terminal import TerminalFleet

    progress = TerminalFleet(options.quiet)
    joint = run_join(record(JoinSettings, options), progress, progress.say)
    if not options.quiet:
        print(f"{joint.sentence}\nOpen {joint.output}/report/index.html in a browser.")
    return EXIT_FAILED if joint.unjoined else 0


def parse(argv: Sequence[str]) -> FleetOptions:
    """Options over those of a preset.

    Raises:
        SystemExit: after ``--help``.
        InputError: an option is wrong or missing.
    """
    return parse_options(FleetOptions, argv, "fleet run", _defaults)


def _defaults(given: Given) -> FleetOptions:
    name = cast(Preset, given.get("preset", "default"))
    return FleetOptions(config=preset(name), preset=name)


def _join_defaults(given: Given) -> JoinOptions:
    name = cast(Preset, given.get("preset", "default"))
    return JoinOptions(config=preset(name), preset=name)
