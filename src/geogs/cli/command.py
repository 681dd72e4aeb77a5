"""Sub-commands of ``geogs``: its own, and those registered by other packages.

A package registers a command by an entry point in the group ``geogs.commands`` that leads to a
:class:`Command`. Its module is imported for ``geogs --help`` and must be light.
"""

import importlib
from collections.abc import Sequence
from dataclasses import dataclass

from geogs.cli.answer import Answer
from geogs.errors import InputError

GROUP = "geogs.commands"
"""Entry points that lead to commands of other packages."""


@dataclass(frozen=True)
class Command:
    """A sub-command: the module whose ``main(argv)`` runs it, and a line of help.

    That function returns an exit code, or an :class:`Answer`, which is printed as text or as JSON.
    """

    module: str
    help: str

    def run(self, argv: Sequence[str]) -> Answer | int:
        """Run the command; returns its answer, or the exit code alone."""
        answer: Answer | int = importlib.import_module(self.module).main(argv)
        return answer


COMMANDS = {
    "run": Command("geogs.cli.run", "reconstruct a video, a folder of images or a data set"),
    "reconstruct": Command("geogs.cli.reconstruct", "reconstruct images whose poses are known"),
    "ros2": Command("geogs.cli.ros2", "track a camera in ROS 2 and publish where it is"),
    "mesh": Command("geogs.cli.mesh", "make the mesh of a result anew, without running again"),
    "scale": Command("geogs.cli.scale", "bring a result to metres by a length that is known"),
    "export": Command("geogs.cli.export", "write a result in the formats of other programs"),
    "locate": Command("geogs.cli.locate", "find where a photograph was taken, in a result's map"),
    "view": Command("geogs.cli.view", "look at a result in the browser"),
    "eval": Command("geogs.cli.eval", "compare a result with the ground truth"),
    "download": Command("geogs.cli.download", "fetch a public sequence, or list those known"),
    "demo": Command("geogs.cli.demo", "make a small room, reconstruct it and show the errors"),
    "weights": Command("geogs.cli.weights", "list the networks' weights, or verify a file"),
    "doctor": Command(
        "geogs.cli.doctor", "show what this machine can do, test it, say what to mend"
    ),
    "completion": Command("geogs.cli.completion", "make the Tab key of a shell complete geogs"),
}
"""Commands of this package."""


def all_commands() -> dict[str, Command]:
    """Every command by name: those of this package, then those of other packages."""
    from importlib.metadata import entry_points

    others = {point.name: point for point in entry_points(group=GROUP)}
    return COMMANDS | {name: others[name].load() for name in sorted(others) if name not in COMMANDS}


def find_command(name: str) -> Command:
    """The command of this name.

    Raises:
        InputError: there is none.
    """
    if name in COMMANDS:
        return COMMANDS[name]
    known = all_commands()
    if name in known:
        return known[name]

    import difflib

    near = difflib.get_close_matches(name, known, n=1)
    hint = f"did you mean {near[0]}?" if near else f"choose one of {', '.join(known)}."
    raise InputError(f"there is no command {name}; {hint}")
