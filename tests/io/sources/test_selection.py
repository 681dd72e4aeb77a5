"""Where reading starts and stops: by numbers of frames, or by times."""

from dataclasses import replace
from pathlib import Path

import pytest

from geogs.cli import run
from geogs.config import InputConfig
from geogs.config.setting import seconds_of
from geogs.errors import InputError
from geogs.io.sources.selection import Selection, selection_of
from geogs.io.sources.sniff import open_source
from io_samples import gradient_image, write_video

NATIVE = InputConfig("70,70,31.5,23.5", long_edge=0, readout=0.0)


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("90s", 90), ("1.5m", 90), ("1.5min", 90), ("2h", 7200), ("1:30", 90), ("0:00.5", 0.5),
        ("1:02:30", 3750), ("90", None), ("1:x", None), ("-1:00", None), ("1:-1", None),
        ("s", None), ("nan:1", None), ("0:inf", None), ("1:2:3:4", None), ("", None), ("-5s", None),
        ("::", None),
    ],
)  # fmt: skip
def test_a_time_is_read_as_people_write_it(text, seconds):
    assert seconds_of(text) == seconds


@pytest.mark.parametrize(
    ("start", "stop", "found"),
    [
        (0, None, Selection(0, None, 2)), ("10s", None, Selection(300, None, 2)),
        (4, "0:01", Selection(4, 30, 2)), ("0:00.5", "2s", Selection(15, 60, 2)),
        ("1:00", 2000, Selection(1800, 2000, 2)),
    ],
)  # fmt: skip
def test_times_become_frames_by_the_rate(start, stop, found):
    config = InputConfig(start=start, stop=stop, stride=2)
    assert selection_of(config, 30.0) == found
    if isinstance(start, str) or isinstance(stop, str):
        with pytest.raises(InputError, match="is a time, and these images have none"):
            selection_of(config, None)


@pytest.mark.parametrize(
    ("start", "stop"), [("2s", "1s"), ("2s", 60), (61, "0:02"), ("0:02", "2s")]
)
def test_nothing_between_start_and_stop_is_refused(start, stop):
    with pytest.raises(InputError, match="must be after start"):
        selection_of(InputConfig(start=start, stop=stop), 30.0)


def test_a_video_is_read_from_one_time_to_another(tmp_path: Path):
    video = write_video(tmp_path / "v.mp4", [gradient_image(k) for k in range(40)])
    by_time = open_source([video], replace(NATIVE, start="0.5s", stop="0:01"))
    by_number = open_source([video], replace(NATIVE, start=15, stop=30))
    times = [frame.timestamp for frame in by_time]
    assert times == [frame.timestamp for frame in by_number]
    assert len(times) == by_time.length == 15
    with pytest.raises(InputError, match="start is 1:00, but the source has only 40 frames"):
        open_source([video], replace(NATIVE, start="1:00"))


def test_the_command_line_takes_both():
    found = run.parse(["v.mp4", "--start", "12", "--stop", "1:30", "--device", "cpu"]).config.input
    assert (found.start, found.stop) == (12, "1:30")
    for wrong in ("soon", "1:xx", "-3", "2.5"):
        with pytest.raises(InputError, match="or a time such as 90s or 1:30"):
            run.parse(["v.mp4", "--start", wrong, "--device", "cpu"])
