"""The ``geogs`` command, before anything of geogs is imported."""

import signal


def main() -> int:
    """Run ``geogs`` with the arguments of the process; returns its exit code.

    Until :func:`geogs.cli.main.main` handles Ctrl-C it ends the process as it ends any other,
    instead of in the middle of an import. Where it is ignored it stays so.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from geogs.cli.main import main as command

    return command()
