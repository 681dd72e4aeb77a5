"""``geogs eval OUT --gt PATH``: errors of a result against the truth."""

from collections.abc import Sequence

from geogs.application.result_settings import EvalSettings
from geogs.cli.answer import Answer
from geogs.cli.options import parse_options
from geogs.guard.terminal_text import printable, say


def main(argv: Sequence[str]) -> Answer:
    """Run the command; returns its answer."""
    options = parse_options(EvalSettings, argv, "eval")

    from rich.console import Console

    from geogs.application.evaluate import evaluate
    from geogs.evaluation.pages.evaluation_page import table

    evaluation = evaluate(options)
    errors = evaluation.trajectory
    say(
        f"True poses: {options.gt}, with {evaluation.settings['clock_of_true_poses']}; "
        f"{errors.pairs} of {errors.estimated} frames matched in time."
    )
    Console(markup=False).print(table(evaluation))
    for sentence in evaluation.doubts:
        Console(stderr=True).print(
            printable(f"warning: {sentence}"), markup=False, style="bold red", highlight=False
        )
    values = {
        "folder": options.output,
        "errors": evaluation.as_dict(),
        "warnings": list(evaluation.doubts),
    }
    return Answer("", values)
