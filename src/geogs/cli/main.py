"""The ``geogs`` command: finds the sub-command and turns errors into sentences.

Nothing heavy is imported before a sub-command is chosen, so that help appears at once.
"""

import errno
import math
import os
import re
import resource
import sys
from collections.abc import Callable, Sequence

from geogs.cli.answer import Answer, Record, shown, wants_json, without_json
from geogs.cli.candidates import ASKED, matching
from geogs.cli.command import all_commands, find_command
from geogs.cli.terminal import process
from geogs.errors import GeogsError
from geogs.guard.terminal_text import printable, say
from geogs.version import __version__

EXIT_ERROR = 2
"""Exit code after an error that the user can fix."""
EXIT_INTERRUPTED = 130
"""Exit code after Ctrl-C where no handler of ours gave one, as in shells (128 + SIGINT)."""
_GPU_FAILS = ("CUDA error", "CUDA out of memory", "CUDA driver error", "cuDNN error", "NVRTC")
"""Beginnings of PyTorch's errors that no command has translated."""
_UNUSABLE = (errno.ENAMETOOLONG, errno.ELOOP, errno.EACCES, errno.EIO, errno.ESTALE, errno.EROFS)
"""System errors for unusable paths."""
_LONG_WORD = re.compile(r"(\S{80})\S{100,}(\S{80})")
"""A word that is shortened to both of its ends, such as a wrongly joined path."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``geogs`` with the given arguments (those of the process if none).

    Returns:
        0 on success, 2 after an error of input, output or options, 3 after a result that is not
        reliable, 130 after Ctrl-C and 143 after SIGTERM, also where a result of the work so far
        was written.
    """
    if argv is not None:
        return _answered(list(argv))
    process.take_over()
    code = _answered(sys.argv[1:])
    process.leave(code)
    return code


def _answered(arguments: list[str]) -> int:
    """Run a command and print its answer, as text or as JSON; returns its exit code."""
    if not wants_json(arguments):
        return _guarded(lambda: _dispatch(arguments), shown, print_error)
    record = Record()
    rest = without_json(arguments)

    def fail(sentence: str) -> None:
        record.fail(sentence)
        print_error(sentence)

    with record.listening():
        code = _guarded(lambda: _dispatch(rest), record.take, fail)
    say(record.text(rest[0] if rest else "", code))
    return code


def _dispatch(arguments: list[str]) -> Answer | int:
    name, *rest = arguments or ["--help"]
    if name in ("-h", "--help", "help"):
        say(*help_text().splitlines())
        return 0
    if rest == [ASKED]:
        helps = {known: command.help for known, command in all_commands().items()}
        say(*matching(helps, name).splitlines())
        return 0
    if name in ("-V", "--version"):
        say(f"geogs {__version__}")
        return 0
    command = find_command(name)
    process.show_warnings()
    # Least address space in bytes; below it, native imports abort the process.
    if _memory_limit() < 1 << 30:
        raise MemoryError
    return command.run(rest)


def help_text() -> str:
    """Text of ``geogs --help``."""
    commands = all_commands()
    width = max(map(len, commands))
    rows = [f"  {name:<{width}}  {command.help}" for name, command in commands.items()]
    return "\n".join(
        [
            "Dense monocular SLAM with a map of geometry-only Gaussian disks.",
            "",
            "usage: geogs COMMAND [OPTIONS]",
            "",
            "commands:",
            *rows,
            "",
            "geogs COMMAND --help lists the options of a command; geogs --version, the version.",
        ]
    )


def print_error(sentence: str) -> None:
    """Print one line to the standard error, in red on a terminal."""
    is_coloured = sys.stderr.isatty() and "NO_COLOR" not in os.environ
    text = "error: " + _LONG_WORD.sub(r"\1...\2", printable(sentence))
    print(f"\033[31m{text}\033[0m" if is_coloured else text, file=sys.stderr)


def _guarded(
    run: Callable[[], Answer | int],
    show: Callable[[Answer | int], int],
    fail: Callable[[str], None],
) -> int:
    """Run a command and show its answer; errors that a user can fix become one line and a code.

    Others keep their traceback, and with ``GEOGS_DEBUG=1`` all do.
    """
    try:
        code = show(run())
        sys.stdout.flush()  # detects a closed pipe here rather than at exit
        return code
    except SystemExit as stop:  # help and wrong options end this way
        return stop.code if isinstance(stop.code, int) else 0 if stop.code is None else EXIT_ERROR
    except KeyboardInterrupt as interrupt:
        fail(" ".join(["interrupted.", *map(str, interrupt.args)]).strip())
        return getattr(interrupt, "code", EXIT_INTERRUPTED)
    except Exception as error:
        sentence = str(error) if isinstance(error, GeogsError) else _resource_error(error)
        if sentence is None or os.environ.get("GEOGS_DEBUG", "0") not in ("", "0"):
            raise
        fail(sentence)
        return EXIT_ERROR


def _resource_error(error: Exception) -> str | None:
    """Message for a lack of system resources; none for other errors, which are bugs."""
    said = str(error)
    if isinstance(error, OSError) and error.errno in (errno.EMFILE, errno.ENFILE):
        return "Too many files are open; raise the limit (ulimit -n)."
    if isinstance(error, OSError) and error.errno == errno.ENOSPC:
        which = "that of the results, or of temporary files (TMPDIR)"
        return f"A disk is full ({error.filename or which}); free some space there."
    if isinstance(error, OSError) and error.errno in _UNUSABLE and error.filename:
        return f"{error.filename} cannot be used ({error.strerror}); give another path."
    if type(error).__name__ == "OutOfMemoryError" or said.startswith(_GPU_FAILS):
        first = said.splitlines()[0][:200].rstrip(".") if said else "out of memory"
        return f"The GPU failed ({first}); --device cpu computes without it."
    if "no locator available" in said:  # numba's message
        return "No folder can be written for compiled kernels; name one by NUMBA_CACHE_DIR."
    lacks = ("allocate memory", "start new thread", "failed to map segment", "Insufficient memory")
    is_told = isinstance(error, MemoryError) or any(words in said for words in lacks)
    # Libraries that cannot be loaded report it in different ways.
    is_unloaded = isinstance(error, ImportError | OSError) and getattr(error, "errno", None) is None
    if is_told or (is_unloaded and _memory_limit() < math.inf):
        return (
            "The memory is full, or may not be used (ulimit -v); use a smaller --long-edge or "
            "fewer frames, and go on with --resume where there is a checkpoint."
        )
    return None


def _memory_limit() -> float:
    """Address space limit of the process in bytes."""
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return math.inf if limit == resource.RLIM_INFINITY else limit


if __name__ == "__main__":
    sys.exit(main())
