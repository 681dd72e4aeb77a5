"""Names of the ways in which a camera is moved."""

from typing import Literal, get_args

MotionKind = Literal[
    "handheld", "slow-handheld", "handheld-5hz", "walking", "turning-30", "turning-60",
    "turning-120", "pure-rotation", "rest-start", "jerks", "still",
]  # fmt: skip
"""Names of the motions."""
ROOM_MOTIONS: tuple[MotionKind, ...] = tuple(kind for kind in get_args(MotionKind))
"""Those through a room."""
