"""Options from dataclasses: what is read, what the help says, what is refused."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import pytest

from geogs.application.result_settings import EvalSettings
from geogs.cli import reconstruct, run
from geogs.cli.help import help_text, is_shown_first
from geogs.cli.options import parse_options
from geogs.config.leaves import former_words, leaves
from geogs.config.setting import Basic, Only, Positional, Range, Settings, Unnamed
from geogs.errors import InputError


@dataclass(frozen=True)
class Sweep(Settings, group="sweep"):
    """A group."""

    plane_count: Annotated[int, Range(2, 256), Basic("-n")] = 8
    """How many planes."""
    step: Annotated[float, Range(above=0), Only("run")] = 0.5
    """How far apart."""
    most: Annotated[int, Range("plane_count")] = 8
    times: tuple[Annotated[float, Range(0, 1)], ...] = (0.2, 0.3)
    smooth: bool = True
    """Smooth ``them``."""


@dataclass(frozen=True)
class Inner:
    """Options without a name of their own."""

    device: str = "auto"
    """Where."""
    sweep: Sweep = field(default_factory=lambda: Sweep(most=9))


@dataclass(frozen=True)
class Outer:
    """Do something.

    Two lines of help.
    """

    source: Annotated[tuple[Path, ...], Positional(unless=("resume",))] = ()
    """What to read."""
    inner: Annotated[Inner, Unnamed] = field(default_factory=Inner)
    resume: Annotated[Path | None, Basic("-r")] = None
    """Where to go on."""
    set: tuple[str, ...] = ()
    """Repeatable."""
    kind: Literal["a", "b"] = "a"


def parse(*argv: str) -> Outer:
    return parse_options(Outer, argv, "run")


def sweep(*argv: str) -> Sweep:
    return parse("x", *argv).inner.sweep


@pytest.mark.parametrize(
    ("argv", "changes"),
    [
        ("", {}),
        ("--sweep.plane-count 4", {"plane_count": 4}),
        ("--sweep.plane_count=4", {"plane_count": 4}),
        ("-n 4 -n 5", {"plane_count": 5}),
        ("--sweep.step 1e-3", {"step": 1e-3}),
        ("--sweep.times 0.1,1", {"times": (0.1, 1.0)}),
        ("--sweep.no-smooth", {"smooth": False}),
        ("--sweep.no-smooth --sweep.smooth", {}),
        ("--sweep.plane-count 100 --sweep.most 200", {"plane_count": 100, "most": 200}),
    ],
)
def test_values_are_read(argv: str, changes: dict) -> None:
    assert sweep(*argv.split()) == replace(Sweep(most=9), **changes)


@pytest.mark.parametrize(
    ("old", "new", "command"),
    [
        ("--field-of-view 60", "--working-field-of-view 60", run),
        ("--input.field_of_view=60", "--working-field-of-view 60", run),
        ("--field-of-view=60", "--working-field-of-view 60", reconstruct),
        ("--offline", "--sfm", run),
        ("--no-offline", "--no-sfm", run),
        ("--poses auto", "--sfm", reconstruct),
        ("--poses=auto --seed 2", "--sfm --seed 2", reconstruct),
        ("--poses given", "--no-sfm", reconstruct),
    ],
)
def test_a_former_name_does_the_same_and_names_the_new_one(old, new, command, caplog) -> None:
    expected = command.parse(["x", "--device", "cpu", *new.split()])
    assert not caplog.messages
    assert command.parse(["x", "--device", "cpu", *old.split()]) == expected
    (warning,) = caplog.messages
    assert f" is now {new.split()[0].removesuffix('=60')};" in warning.replace("input.", "")
    assert old.split("=")[0].split()[0].replace("_", "-") in warning


@pytest.mark.parametrize(
    "words", [["-o", "out", "--resume"], ["--resume", "--seed", "1", "--output", "out"]]
)
def test_a_bare_resume_takes_the_folder_of_the_output(words, caplog) -> None:
    found = reconstruct.parse(["x", "--device", "cpu", *words])
    assert found.resume == Path("out")
    assert "--resume is now --resume out;" in caplog.messages[0]
    with pytest.raises(InputError, match="needs the folder"):
        reconstruct.parse(["x", "--resume", "--device", "cpu"])
    given = reconstruct.parse(["x", "--resume", "there", "--device", "cpu"])
    assert (given.resume, given.output) == (Path("there"), None)


def test_a_former_name_is_offered_by_no_help_and_taken_by_no_other_option() -> None:
    for options, command in (
        (run.RunOptions, "run"),
        (reconstruct.ReconstructOptions, "reconstruct"),
    ):
        known = leaves(options, command)
        names = {name for leaf in known for name in leaf.options}
        former = former_words(known)
        assert former
        assert not {old for old in former if " " not in old} & names
        assert " --offline" not in help_text(options, command, everything=True)
    assert run.parse(["x", "--poses", "auto", "--device", "cpu"]).config.input.poses == "auto"
    assert run.parse(["--device", "cpu", "--", "--offline"]).source == (Path("--offline"),)


def test_words_without_a_name_go_to_their_places() -> None:
    assert parse("a", "--kind", "b", "c").source == (Path("a"), Path("c"))
    assert parse("a", "--", "--kind").source == (Path("a"), Path("--kind"))
    assert parse("-r", "out") == Outer(resume=Path("out"))
    assert parse("a", "--set", "x=1,2", "--set", "y=-3").set == ("x=1,2", "y=-3")
    assert parse("a", "--device", "cpu").inner == Inner("cpu")


def test_defaults_may_follow_from_what_is_given() -> None:
    def default(given) -> Outer:
        seen.update(given)
        return Outer(kind="b", inner=Inner("cuda", Sweep(plane_count=3)))

    seen: dict[str, str] = {}
    options = parse_options(Outer, ["a", "--sweep.most", "7", "--sweep.smooth"], "run", default)
    assert options.inner == Inner("cuda", Sweep(plane_count=3, most=7))
    assert options.kind == "b"
    assert seen == {"source": "a", "sweep.most": "7", "sweep.smooth": "on"}


@pytest.mark.parametrize(
    ("argv", "sentence"),
    [
        ("--sweep.plane-count two", "sweep.plane-count is 'two', but must be a whole number from "),
        ("--sweep.plane-count 1", "sweep.plane-count is 1, but must be a whole number from 2 to 2"),
        ("--sweep.plane-count 9 --sweep.most 8", "sweep.most is 8, but must be a whole number at "),
        ("--sweep.step nan", "sweep.step is nan, but must be a number above 0."),
        ("--sweep.step inf", "sweep.step is inf, but must be a number above 0."),
        ("--sweep.step", "--sweep.step needs a value: a number above 0."),
        ("--resume --kind b", "--resume needs a value: none or a path."),
        ("--sweep.stop 3", "geogs run has no option --sweep.stop; did you mean --sweep.step?"),
        ("--zzzzzzzz", "geogs run has no option --zzzzzzzz; see geogs run --help-all."),
        ("--sweep.smooth=off", "geogs run has no option --sweep.smooth=off; did you mean --sweep"),
        ("--kind c", "kind is 'c', but must be a or b."),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_sentence(argv: str, sentence: str) -> None:
    with pytest.raises(InputError) as error:
        parse("x", *argv.split())
    assert str(error.value).startswith(sentence)
    assert str(error.value).endswith((".", "?"))


def test_a_missing_word_is_named() -> None:
    with pytest.raises(InputError, match=r"geogs run needs SOURCE: what to read\."):
        parse("--kind", "b")
    with pytest.raises(InputError, match=r"geogs eval needs --gt: true poses\."):
        parse_options(EvalSettings, ["x"], "eval")


def test_no_arguments_show_the_usage(capsys) -> None:
    with pytest.raises(SystemExit) as stop:
        parse()
    assert stop.value.code == 2
    assert capsys.readouterr().err.startswith("usage: geogs run SOURCE... [OPTIONS]\n\nDo someth")


def test_an_option_of_another_command_is_not_offered() -> None:
    with pytest.raises(InputError, match=r"geogs reconstruct has no option --sweep\.step"):
        parse_options(Outer, ["a", "--sweep.step", "1"], "reconstruct")
    assert "--sweep.step" in help_text(Outer, "run", everything=True)
    assert "--sweep.step" not in help_text(Outer, "reconstruct", everything=True)


def test_help_shows_the_basic_options_and_the_rest_on_demand(capsys) -> None:
    few, all_ = (help_text(Outer, "run", everything) for everything in (False, True))
    assert few.splitlines()[2:5] == ["Do something.", "", "Two lines of help."]
    assert "  -n, --sweep.plane-count N How many planes. (8; from 2 to 256)" not in few
    assert "-n, --sweep.plane-count N\n" in few
    assert "How many planes. (8; from 2 to 256)" in few
    assert "  -r, --resume PATH         Where to go on. (none)" in few
    assert "--sweep.step" not in few
    assert few.endswith("geogs run --help-all shows all 10 options.")
    assert "  --sweep.[no-]smooth       Smooth them. (on)" in all_
    assert "(0.2,0.3; from 0 to 1)" in all_
    for flag, text in (("--help", few), ("-h", few), ("--help-all", all_)):
        with pytest.raises(SystemExit) as stop:
            parse("x", flag)
        assert stop.value.code == 0
        assert capsys.readouterr().out == text + "\n"


@pytest.mark.parametrize(
    ("options", "command"),
    [(run.RunOptions, "run"), (reconstruct.ReconstructOptions, "reconstruct")],
)
def test_the_common_options_fit_on_a_screen(options: type, command: str) -> None:
    known = leaves(options, command)
    common = [leaf for leaf in known if is_shown_first(leaf)]
    assert 15 <= len(common) <= 32
    text = help_text(options, command, everything=False)
    assert len(text.splitlines()) <= 45
    assert max(map(len, text.splitlines())) <= 100
    for leaf in common:
        assert leaf.mark(Positional) or f"{leaf.options[-1]}" in text or leaf.default is True
    full = help_text(options, command, everything=True)
    assert all(leaf.name in full for leaf in known if leaf.kind.base is not bool and leaf.options)
    assert all(leaf.help for leaf in known)
    basic = [leaf for leaf in known if leaf.mark(Basic) is not None]
    names = [leaf.name for leaf in known]
    names += [leaf.mark(Basic).name for leaf in basic if leaf.mark(Basic) and leaf.mark(Basic).name]
    assert len(set(names)) == len(names)


def test_reconstruct_offers_nothing_that_only_tracking_heeds() -> None:
    offered = {leaf.name for leaf in leaves(reconstruct.ReconstructOptions, "reconstruct")}
    assert {"mapping.lr-final", "mapping.depth.planes", "search.repeat"} <= offered
    assert not {
        "mapping.lag", "mapping.window", "mapping.iterations",
        "mapping.views-per-step", "mapping.final-iterations", "mapping.final-depth",
        "mapping.pose-iterations", "mapping.pose-lr", "mapping.ablation.map-update",
        "mapping.loss.normal-weight",
    } & offered  # fmt: skip
    assert not any(name.startswith(("tracking.", "loop.", "calibration.")) for name in offered)
    with pytest.raises(InputError, match=r"geogs reconstruct has no option --mapping\.lag"):
        reconstruct.parse(["x", "--device", "cpu", "--mapping.lag", "3"])
