"""Photoconsistency of a textured plane seen by cameras on an arc."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from geogs.errors import InputError
from geogs.evaluation.surfaces.photoconsistency import choose_neighbours, evaluate_photoconsistency
from geogs.geometry.lie import so3_exp
from geogs.io.sources.posed.posed_source import PosedImage
from surface_shapes import CAMERA, joined, plane


def arc(degrees: float, distance: float = 2.0) -> np.ndarray:
    """World to camera, looking at (0, 0, 2) from an angle about the vertical axis."""
    turn = torch.tensor([0.0, np.radians(degrees), 0.0], dtype=torch.float64)
    T_wc = np.eye(4)
    T_wc[:3, :3] = so3_exp(turn).numpy()
    T_wc[:3, 3] = np.array([0, 0, 2.0]) - distance * T_wc[:3, 2]
    return np.linalg.inv(T_wc)


def photograph(T_cw: np.ndarray, texture: np.ndarray) -> np.ndarray:
    """The plane z = 2 with a texture of 100 texels a unit, as the camera sees it, exactly."""
    from scipy.ndimage import map_coordinates

    T = np.linalg.inv(T_cw)
    rays = CAMERA.rays(torch.float64).numpy() @ T[:3, :3].T
    s = (2 - T[2, 3]) / rays[..., 2]
    x, y = (T[k, 3] + s * rays[..., k] for k in (0, 1))
    grey = map_coordinates(texture, [100 * y + 200, 100 * x + 200], order=1, mode="nearest")
    return np.repeat(grey.round().clip(0, 255).astype(np.uint8)[..., None], 3, 2)


def posed(image: np.ndarray, T_cw: np.ndarray, mask: np.ndarray | None = None) -> PosedImage:
    return PosedImage(0, "", 0.0, image, T_cw, mask)


@pytest.fixture(scope="module")
def views() -> list[PosedImage]:
    rough = gaussian_filter(np.random.default_rng(0).normal(size=(401, 401)), 2.0)
    texture = 128 + 60 * rough / rough.std()
    poses = [arc(a) for a in (0.0, 12.0, -12.0)]
    return [posed(photograph(T, texture), T) for T in poses]


def score(mesh, views):
    return evaluate_photoconsistency(mesh, CAMERA, views, [0])


def test_true_plane_beats_planes_one_percent_off(views):
    true = score(plane(2.0, half=2.0), views)
    assert true.ncc_median > 0.97
    assert true.ncc_mean > 0.95
    assert (true.views, true.pairs) == (1, 2)
    # A tenth or so of the image is beyond the edge of the others'.
    assert 95 < true.coverage <= 100
    assert true.textured > 95
    for z in (1.98, 2.02):
        wrong = score(plane(z, half=2.0), views)
        assert wrong.score < true.score - 1
        assert wrong.ncc_mean < true.ncc_mean - 0.01
    assert score(plane(2.2, half=2.0), views).ncc_mean < 0.5
    assert score(plane(2.0, half=2.0), views) == true


def test_a_hole_loses_its_part_of_the_score(views):
    whole = plane(2.0, half=2.0, cells=40)
    middle = np.abs(whole.vertices[whole.faces][..., :2]).max((1, 2)) <= 0.301
    full, holed = score(whole, views), score(whole.part(~middle), views)
    part = 100 * 0.6 * 0.6 / (1.6 * 1.2) / 4  # of the image: it is 3.2 by 2.4 at the plane
    assert full.coverage - holed.coverage == pytest.approx(part, abs=0.5)
    assert holed.ncc_mean == pytest.approx(full.ncc_mean, abs=0.01)
    # Windows across the edge still have half their pixels, so a little less is lost.
    assert 0.6 * part < full.score - holed.score < 1.1 * part


def test_what_is_hidden_in_the_neighbour_is_not_compared(views):
    """A screen before the second camera hides the plane from it, and from no other."""
    T_wc = np.linalg.inv(views[1].T_cw)
    screen = plane(0.2, half=0.3).transformed(T_wc)
    seen = score(plane(2.0, half=2.0), views[:2])
    hidden = score(joined(plane(2.0, half=2.0), screen), views[:2])
    assert seen.coverage > 90
    assert hidden.coverage < 2


def test_masks_limit_what_counts(views):
    mask = np.zeros((120, 160), bool)
    mask[40:80, 60:100] = True
    view = posed(views[0].image, views[0].T_cw, mask)
    small = plane(2.0, half=0.45)  # 45 pixels, more than the mask
    assert score(small, [view, *views[1:]]).coverage == 100
    assert score(small, views).coverage == pytest.approx(100 * 45**2 / (160 * 120), abs=1)


def test_neighbours_by_poses_alone():
    angles = [0, 1, 5, 11, 20, 29, 33, -14]
    assert choose_neighbours(0, [arc(float(a)) for a in angles], 3) == [3, 7, 2]
    outwards = [arc(0.0, -2.0), arc(12.0, -2.0)]
    assert choose_neighbours(0, outwards, 3) == []
    with pytest.raises(InputError, match="from another side"):
        score(plane(2.0), [posed(np.zeros((120, 160, 3), np.uint8), np.eye(4))])


def test_plain_images_cannot_be_judged(views):
    plain = [posed(np.full_like(v.image, 90), v.T_cw) for v in views]
    with pytest.raises(InputError, match="no texture"):
        score(plane(2.0, half=2.0), plain)
