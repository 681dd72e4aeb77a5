"""``geogs completion SHELL``: the Tab key completes commands, options and their values.

A shell is given a few lines that ask the command itself, so that they are never out of date: the
words typed so far, the last one unfinished, and ``--complete`` behind them. What could stand for
the last one is printed a line each, with a tabulator and a few words after it where there is
something to say. Nothing printed means a file.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from geogs.cli.help import first_clause, is_shown_first
from geogs.config.leaves import Leaf
from geogs.config.setting import Positional, dashed

ASKED = "--complete"
"""Last of the arguments where a shell asks."""

SCRIPTS = {
    "bash": """\
_geogs() {
    local IFS=$'\\n'
    COMPREPLY=($("${COMP_WORDS[@]:0:COMP_CWORD+1}" --complete 2>/dev/null | cut -f 1))
}
complete -o bashdefault -o default -F _geogs geogs""",
    "zsh": """\
#compdef geogs
_geogs() {
    local -a found
    found=("${(@f)$("${(@)words[1,CURRENT]}" --complete 2>/dev/null)}")
    if [[ -z "$found" ]]; then _files; return; fi
    found=("${(@)found//:/\\\\:}")
    found=("${(@)found/$'\\t'/:}")
    _describe geogs found
}
compdef _geogs geogs""",
    "fish": """\
function __geogs
    set -l words (commandline -opc) (commandline -ct | string collect --allow-empty)
    $words --complete 2>/dev/null
end
complete -c geogs -a '(__geogs)'""",
}


@dataclass(frozen=True)
class CompletionOptions:
    """Print what makes a shell complete geogs on the Tab key.

    bash: eval "$(geogs completion bash)" in ~/.bashrc; zsh: eval "$(geogs completion zsh)" in
    ~/.zshrc, after compinit; fish: geogs completion fish | source in ~/.config/fish/config.fish.
    """

    shell: Annotated[Literal["bash", "zsh", "fish"], Positional()]
    """Which shell."""


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    from geogs.cli.options import parse_options  # which asks here for completions

    print(SCRIPTS[parse_options(CompletionOptions, argv, "completion").shell])
    return 0


def matching(found: Mapping[str, str], unfinished: str) -> str:
    """Lines for a shell: what begins like the unfinished word, and what it is."""
    named = [(name, text) for name, text in found.items() if name.startswith(unfinished)]
    return "\n".join(f"{name}\t{text}" if text else name for name, text in named)


def candidates(known: Sequence[Leaf], typed: Sequence[str]) -> dict[str, str]:
    """What could stand for the last of the words typed, and what each of them is."""
    *before, unfinished = typed or [""]
    taking = {name: leaf for leaf in known if leaf.kind.base is not bool for name in leaf.options}
    last = taking.get(dashed(before[-1])) if before else None
    if last is not None:
        return dict.fromkeys(last.kind.choices, "")
    if unfinished.startswith("-"):
        offered = known if unfinished.strip("-") else filter(is_shown_first, known)
        return {name: first_clause(leaf.help) for leaf in offered for name in _names(leaf)}
    places = (leaf for leaf in known if leaf.mark(Positional) is not None)
    return {choice: "" for leaf in places for choice in leaf.kind.choices}


def _names(leaf: Leaf) -> Iterator[str]:
    yield from leaf.options
    if leaf.kind.base is bool and leaf.options:
        yield leaf.switch_off
