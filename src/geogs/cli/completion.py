"""``geogs completion SHELL``: the Tab key completes commands, options and their values.

A shell gets a short script that calls the command itself, so that it is never out of date, with the
words typed so far, the last one unfinished, and ``--complete`` after them. Completions of the last
word are printed one per line, with a tab and a description where there is one. No output means a
file.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from geogs.cli.options import parse_options
from geogs.config.setting import Positional
from geogs.guard.terminal_text import say

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
    say(*SCRIPTS[parse_options(CompletionOptions, argv, "completion").shell].splitlines())
    return 0
