"""The rows of the board: commands and their footage."""

from dataclasses import dataclass

from geogs_bench.board.footage import Footage, KeptFootage, Size

SEEDS = (0, 1, 2)
"""Each command is run once for each: with this seed, and from the image of this number on, so that
tracking and mapping both vary a little."""


@dataclass(frozen=True)
class Row:
    """A command on a sequence."""

    name: str
    """Name of the row and of its folder."""
    footage: str
    command: str
    """Command as a user types it, without the output and the device; ``{folder}``, ``{video}`` and
    ``{camera}`` are replaced by the files of the sequence."""
    runs_alone: bool = False
    """Whether nothing else runs at the same time, as its result depends on timing."""
    has_empty_cache: bool = False
    """Whether it starts without compiled code."""


_SMALL = Size(72, 160, 120, stride=2)
_FULL = Size(150, 400, 300)

FOOTAGE = (
    Footage("handheld-kinect", "handheld", "kinect", 31, _SMALL, Size(100, 400, 300)),
    Footage("turning-60", "turning-60", "clean", 32, _SMALL, _FULL),
    Footage("walking-phone", "walking", "phone", 33, _SMALL, _FULL),
    Footage("street", "driving", "clean", 34, Size(32, 256, 78), Size(120, 800, 242)),
    Footage("corridor", "corridor", "kinect", 35, _SMALL, _FULL),
    Footage(
        "weak-link",
        "handheld-5hz",
        "phone",
        36,
        Size(40, 160, 120),
        Size(80, 400, 300),
        gap=(0.5, 0.6),
    ),
    Footage("dining", "dining", "clean", 37, Size(72, 160, 120, stride=2), Size(200, 480, 272)),
    Footage("slow-stream", "handheld-5hz", "clean", 38, Size(32, 160, 120), Size(40, 400, 300)),
)
"""Rooms, a street and a corridor, each with its own seed, filmed by cameras with flaws."""

KEPT = (
    KeptFootage("staircase", "rooms/staircase", "--stop 40 --long-edge 160", "--stop 150"),
    KeptFootage(
        "living-room-light", "rooms/living-room-2-light", "--stop 40 --long-edge 160", "--stop 150"
    ),
    KeptFootage("kitchen", "7scenes-redkitchen/seq-01", "--stop 60 --long-edge 160", "--stop 120"),
    KeptFootage("horse", "objects/horse", "--long-edge 160", "--long-edge 640"),
)
"""Sequences that the user may have."""

_SITUATIONS = (
    Row("kinect", "handheld-kinect", "run {folder}"),
    Row("turning-60", "turning-60", "run {folder}"),
    Row("walking", "walking-phone", "run {folder}"),
    Row("street", "street", "run {folder}"),
    Row("corridor", "corridor", "run {folder}"),
    Row("weak-link", "weak-link", "run {folder}"),
    Row("dining", "dining", "run {folder}"),
    Row("no-lens", "walking-phone", "run {video}"),
)
_WAYS = (
    Row("paper", "dining", "run {folder} --preset paper"),
    Row("online-results", "dining", "run {folder} --online-results"),
    Row("fast", "handheld-kinect", "run {folder} --preset fast"),
    Row("accurate", "handheld-kinect", "run {folder} --preset accurate"),
    Row("own", "handheld-kinect", "run {folder} --tracking.operator own"),
    Row("offline", "weak-link", "run {folder} --sfm"),
    Row("posed", "slow-stream", "reconstruct {folder}"),
    Row(
        "posed-paper",
        "handheld-kinect",
        "reconstruct {folder} --preset paper --search.most-views 12",
    ),
    Row("first-command", "handheld-kinect", "run {folder}", has_empty_cache=True),
)
_KEPT = (
    Row("staircase", "staircase", "run {folder}"),
    Row("changing-light", "living-room-light", "run {folder}"),
    Row("kitchen", "kitchen", "run {folder}"),
    Row("horse", "horse", "reconstruct {folder}"),
)
_BUDGET = Row("posed-10s", "slow-stream", "reconstruct {folder} --budget 10s", runs_alone=True)
_LIVE = "run play:{video} --intrinsics {camera}"
_LIVE_ON_CPU = Row("live-5hz", "slow-stream", _LIVE, runs_alone=True)
_LIVE_ON_GPU = Row("live-30hz", "turning-60", _LIVE, runs_alone=True)


def rows(on_gpu: bool) -> tuple[Row, ...]:
    """All rows; those that run alone come last."""
    live = _LIVE_ON_GPU if on_gpu else _LIVE_ON_CPU
    return (*_WAYS, *_SITUATIONS, *_KEPT, _BUDGET, live)
