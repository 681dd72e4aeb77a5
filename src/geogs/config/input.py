"""How a source is read."""

from dataclasses import dataclass


@dataclass(frozen=True)
class InputConfig:
    """How the source is read."""

    intrinsics: str = "auto"
    """auto, a file, or fx,fy,cx,cy[,k1,k2,p1,p2[,k3]] in pixels of the source image."""
    long_edge: int = 512
    """Longer side of the working image in pixels; smaller sources are not enlarged, 0 keeps all."""
    start: int = 0
    """First frame of the source, from 0."""
    stop: int | None = None
    """Frame of the source before which to stop; none reads to the end."""
    stride: int = 1
    """Use every stride-th frame, at least 1."""
