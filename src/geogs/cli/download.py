"""``geogs download NAME DIR``: a public sequence, fetched and unpacked."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from geogs.application.download.sequences import SEQUENCES, find_sequence
from geogs.application.run_settings import Verbosity
from geogs.cli.answer import Answer
from geogs.cli.options import parse_options
from geogs.config.setting import Positional
from geogs.guard.terminal_text import printable


@dataclass(frozen=True)
class DownloadOptions(Verbosity):
    """Fetch a public sequence with its true poses; without a name, list those that are known.

    The same command continues an interrupted download. The licence is that of the data set's
    makers, who also say what to cite.
    """

    name: Annotated[str, Positional(required=False)] = ""
    """The sequence, such as tum/fr1_desk."""
    into: Annotated[Path, Positional(required=False)] = Path()
    """Folder into which its folder comes."""


def main(argv: Sequence[str]) -> Answer:
    """Run the command; returns its answer."""
    options = parse_options(DownloadOptions, argv, "download")
    if not options.name:
        names = {"sequences": [sequence.name for sequence in SEQUENCES]}
        return Answer(listing(), names)
    sequence = find_sequence(options.name)

    from geogs.application.download.download import download
    from geogs.application.progress.terminal_progress import TerminalProgress

    with TerminalProgress(options) as progress:
        progress.write(f"{sequence.name}: licence {sequence.licence}, see {sequence.page}")
        place = download(sequence, options.into, progress)
    name = printable(place)
    text = f"geogs run {name} reads it, and geogs eval RESULT --gt {name} its true poses."
    return Answer(text, {"folder": place})


def listing() -> str:
    """List of the known sequences, with their licences."""
    width = max(len(sequence.name) for sequence in SEQUENCES)
    lines = [f"  {s.name:<{width}}  {s.licence:<16} {s.page}" for s in SEQUENCES]
    return "\n".join(["geogs download NAME DIR, of", *lines])
