"""Matches of a reconstruction as rays through the lens that it found."""

from pathlib import Path

import numpy as np
import pytest

from geogs_photos.verified_matches import verified_matches

pycolmap = pytest.importorskip("pycolmap")
FOLDING = [100.0, 160.0, 120.0, -0.5]
"""A lens that no ray comes through near the corners: f, cx, cy, k."""


@pytest.fixture
def model_and_database(tmp_path: Path):
    """Three pictures of which one and two match all over, and two and three at a corner alone."""
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=320, height=240, params=FOLDING)
    camera.camera_id = 1
    middle = np.array([[150.0, 110.0], [170.0, 130.0], [160.0, 140.0], [2.0, 2.0]])
    path = tmp_path / "matches.db"
    reconstruction = pycolmap.Reconstruction()
    with pycolmap.Database.open(path) as database:
        database.write_camera(camera, use_camera_id=True)
        reconstruction.add_camera_with_trivial_rig(camera)
        for n in (1, 2, 3):
            image = pycolmap.Image(name=f"{n}.png", camera_id=1, image_id=n)
            database.write_image(image, use_image_id=True)
            database.write_keypoints(n, middle.astype(np.float32))
            reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
        for one, two, cells in ((1, 2, [0, 1, 2, 3]), (2, 3, [3])):
            matches = np.array([[c, c] for c in cells], np.uint32)
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = matches
            database.write_matches(one, two, matches)
            database.write_two_view_geometry(one, two, geometry)
    return reconstruction, path


def test_pixels_that_the_lens_does_not_see_match_nothing(model_and_database):
    model, database = model_and_database
    corner = np.asarray(model.cameras[1].cam_from_img(np.array([[2.0, 2.0]])), float)
    assert not np.isfinite(corner).all()
    (pair,) = verified_matches(model, database, (1, 2, 3))
    assert (pair.one, pair.other) == (1, 2)
    assert pair.rays[0].shape == (3, 3)
    assert np.isfinite(pair.epipolar()).all()
