"""Orientations from turns between frames."""

import numpy as np
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from geogs.tracking.frames.rotation_averaging import orientations
from geogs.world.frames import RelativeRotation


def rotations(count: int, seed: int = 0) -> list[torch.Tensor]:
    """World to camera of a camera that looks around."""
    steps = np.random.default_rng(seed).normal(0, 0.2, (count, 3))
    R = [np.eye(3)]
    for step in steps[1:]:
        R.append(Rotation.from_rotvec(step).as_matrix() @ R[-1])
    return [torch.from_numpy(r) for r in R]


def relative(
    R: list[torch.Tensor], a: int, b: int, error: np.ndarray | None = None
) -> RelativeRotation:
    wrong = np.eye(3) if error is None else Rotation.from_rotvec(error).as_matrix()
    return RelativeRotation(a, torch.from_numpy(wrong) @ R[b] @ R[a].mT, 0.01)


def test_a_chain_is_followed_in_both_directions() -> None:
    R = rotations(6)
    found = orientations({k: [relative(R, k - 1, k)] for k in range(1, 6)}, {3: R[3]})
    assert sorted(found) == [0, 1, 2, 4, 5]
    for k, r in found.items():
        torch.testing.assert_close(r, R[k])


def test_what_nothing_links_has_no_orientation() -> None:
    R = rotations(8)
    turns = {k: [relative(R, k - 1, k)] for k in (1, 2, 5, 6, 7)}
    assert sorted(orientations(turns, {0: R[0]})) == [1, 2]
    alone = orientations(turns, {})  # 4 to 7 are more than 0 to 2
    assert sorted(alone) == [4, 5, 6, 7]
    torch.testing.assert_close(alone[4], torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(alone[7], R[7] @ R[4].mT)
    assert orientations({}, {}) == {}


def test_contradictions_are_spread_as_by_a_general_minimiser() -> None:
    R, rng = rotations(7, 3), np.random.default_rng(1)
    links = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 6), (0, 3), (2, 5)]
    turns: dict[int, list[RelativeRotation]] = {}
    for a, b in links:
        one = relative(R, a, b, rng.normal(0, 0.02, 3))
        turns.setdefault(b, []).append(RelativeRotation(a, one.R, float(rng.uniform(0.01, 0.03))))
    found = orientations(turns, {0: R[0], 6: R[6]})

    def errors(x: np.ndarray) -> np.ndarray:
        at = {0: R[0].numpy(), 6: R[6].numpy()}
        at |= {k + 1: Rotation.from_rotvec(x[3 * k : 3 * k + 3]).as_matrix() for k in range(5)}
        return np.concatenate([
            Rotation.from_matrix(t.R.numpy() @ (at[b] @ at[t.frame].T).T).as_rotvec() / t.deviation
            for b, several in turns.items() for t in several
        ])  # fmt: skip

    x = np.concatenate([Rotation.from_matrix(R[k].numpy()).as_rotvec() for k in range(1, 6)])
    best = least_squares(errors, x, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    ours = np.concatenate([Rotation.from_matrix(found[k].numpy()).as_rotvec() for k in range(1, 6)])
    assert np.square(errors(ours)).sum() < 1.001 * 2 * best.cost
    np.testing.assert_allclose(ours, best.x, atol=2e-4)
