"""Names of the kinds of camera motion and of light."""

from typing import Literal, get_args

RoomMotionKind = Literal[
    "handheld", "slow-handheld", "handheld-5hz", "walking", "turning-30", "turning-60",
    "turning-120", "pure-rotation", "turn-away", "rest-start", "jerks", "still",
]  # fmt: skip
"""Motions through a room."""
ROOM_MOTIONS: tuple[RoomMotionKind, ...] = get_args(RoomMotionKind)
MotionKind = Literal[RoomMotionKind, "dining", "driving", "corridor", "white-panel", "weak-link"]
"""Motions through a room, around a table in a room of thin things, along a street, along a corridor
almost without texture, or past a white panel that leaves a margin of texture or none."""
LampKind = Literal["steady", "switched"]
"""Constant lamps, or other lamps in each third of the sequence."""
