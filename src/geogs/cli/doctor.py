"""``geogs doctor``: diagnosis of this machine, and problems to fix."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

from geogs.cli.answer import Answer
from geogs.cli.options import parse_options
from geogs.guard.terminal_text import say


@dataclass(frozen=True)
class DoctorOptions:
    """Show versions, GPU and kernel cache; test and time the renderer; say what to mend."""

    device: str = "auto"
    """What to test: cpu, cuda or cuda:1; auto takes a GPU if one can be used."""


def main(argv: Sequence[str]) -> Answer:
    """Run the command; its exit code is 0 if the self-test passes, else 2."""
    options = parse_options(DoctorOptions, argv, "doctor")

    from geogs.application.machine.doctor import examine

    findings = []
    for finding in examine(options.device):
        say(f"{finding.name:<13} {finding.text}")
        findings.append(finding)
    problems = [f.problem for f in findings if f.problem]
    lines = ["To mend:", *(f"  - {problem}" for problem in problems)]
    text = "\n".join(["", *(lines if problems else ["everything works"])])
    values = {"findings": [asdict(finding) for finding in findings]}
    return Answer(text, values, 2 if any(f.is_fatal for f in findings) else 0)
