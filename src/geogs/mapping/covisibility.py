"""Which keyframes see the same surface from usefully different places."""

import numpy as np
from jaxtyping import Float


def parallax_degrees(
    centre_a: Float[np.ndarray, "3"],
    centre_b: Float[np.ndarray, "3"],
    point: Float[np.ndarray, "3"],
) -> float:
    """Angle in degrees under which ``point`` sees the two camera centres (world frame)."""
    return _angle(point - centre_a, point - centre_b)


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    cosine = a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-30)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def pair_score(
    T_wc_a: Float[np.ndarray, "4 4"],
    T_wc_b: Float[np.ndarray, "4 4"],
    depth: float,
    *,
    best: float,
    smallest: float,
    largest: float,
    looking_within: float,
) -> float:
    """How ill-suited keyframe b is to check keyframe a by stereo; lower is better, inf is never.

    Judged on the point at ``depth`` along a's optical axis: its parallax in degrees should be near
    ``best`` on a log scale and within [smallest, largest], and both cameras should look the same
    way within ``looking_within`` degrees.
    """
    point = T_wc_a[:3, 3] + depth * T_wc_a[:3, 2]
    parallax = parallax_degrees(T_wc_a[:3, 3], T_wc_b[:3, 3], point)
    turn = _angle(T_wc_a[:3, 2], T_wc_b[:3, 2])
    if not smallest <= parallax <= largest or turn > looking_within:
        return float("inf")
    return abs(float(np.log(parallax / best))) + (turn / 20.0) ** 2
