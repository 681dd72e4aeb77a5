"""The Tab key: what is offered, and that each shell is offered it."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from geogs.cli import main as cli
from geogs.cli.command import all_commands
from geogs.cli.completion import SCRIPTS


@pytest.fixture
def offered(capsys):
    """What could stand for the last of some words."""

    def ask(*words: str) -> list[str]:
        assert cli.main([*words, "--complete"]) == 0
        said = capsys.readouterr().out.splitlines()
        return [line.split("\t")[0] for line in said if line]

    return ask


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A folder with a ``geogs`` to call, and a file."""
    program = tmp_path / "geogs"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m geogs.cli.main "$@"\n')
    program.chmod(0o755)
    (tmp_path / "video.mp4").touch()
    return tmp_path


def in_shell(home: Path, name: str, script: str) -> list[str]:
    """Lines that a shell says in that folder, once it knows how geogs is completed."""
    if shutil.which(name) is None:
        pytest.skip(f"there is no {name} on this machine")
    plain = {"bash": ["--norc"], "zsh": ["-f"], "fish": ["--no-config"]}[name]
    path = f"PATH={home}:/usr/bin:/bin"
    environment = ["env", "-i", path, f"HOME={home}", f"PYTHONPATH={':'.join(sys.path)}"]
    said = subprocess.run(
        [*environment, name, *plain, "-c", script],
        capture_output=True, text=True, check=True, cwd=home,
    )  # fmt: skip
    assert said.stderr == ""
    return said.stdout.splitlines()


def test_commands_are_offered_with_those_of_packages_beside(offered):
    assert offered("") == list(all_commands())
    assert offered("re") == ["reconstruct"]
    assert offered("zzz") == []


def test_options_are_offered_few_at_first_and_all_that_begin_so(offered):
    few, all_ = offered("run", "--"), offered("run", "--m")
    assert "--preset" in few
    assert "--mapping.window" not in few
    assert {"--mapping.window", "--mask", "--map"} <= set(all_)
    assert offered("run", "a.mp4", "--no-fall") == ["--no-fallback"]
    assert offered("reconstruct", "--global-ba") == []
    assert offered("weights", "--js") == ["--json"]


def test_values_are_offered_after_the_option_they_belong_to(offered):
    assert offered("run", "--preset", "") == ["default", "fast", "accurate", "paper"]
    assert offered("run", "a.mp4", "--depth", "s") == ["sensor"]
    assert offered("weights", "v") == ["verify"]
    assert offered("run", "--sfm", "vi") == []  # a file, which the shell knows


def test_bash_completes(home):
    script = """
        eval "$(geogs completion bash)"
        complete -p geogs
        COMP_WORDS=(geogs run --preset f); COMP_CWORD=3; _geogs; echo "${COMPREPLY[@]}"
        COMP_WORDS=(geogs run v); COMP_CWORD=2; _geogs; echo "${#COMPREPLY[@]}"
    """
    registered, values, files = in_shell(home, "bash", script)
    assert "-o default" in registered
    assert (values, files) == ("fast", "0")


def test_fish_completes(home):
    script = "geogs completion fish | source; complete -C '{}'"
    values = in_shell(home, "fish", script.format("geogs run --preset f"))
    assert values[0] == "fast"
    assert in_shell(home, "fish", script.format("geogs run vid")) == ["video.mp4"]
    assert in_shell(home, "fish", script.format("geogs recon"))[0].startswith("reconstruct\t")


def test_zsh_completes(home):
    """By stand-ins for what its completion system does with what it is given."""
    script = """
        compdef() { print "$@" }; _files() { print files }
        _describe() { print -rl -- "${(@P)2}" }
        eval "$(geogs completion zsh)"
        words=(geogs run --mesh.v); CURRENT=3; _geogs
        words=(geogs run v); CURRENT=3; _geogs
    """
    registered, option, files = in_shell(home, "zsh", script)
    assert registered == "_geogs geogs"
    assert option.startswith("--mesh.voxel:Voxel size")
    assert files == "files"


def test_a_shell_that_is_not_known_is_refused(capsys):
    assert cli.main(["completion", "tcsh"]) == 2
    said = capsys.readouterr().err
    assert all(shell in said for shell in SCRIPTS)
