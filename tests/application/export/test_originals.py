"""Image sets with the source's images at full size: undistorted, each with its pose."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import geogs
from geogs.application.export.export import export, exports_of
from geogs.application.result_settings import ExportSettings
from geogs.application.results.write import write_config
from geogs.camera.shutter.shutter import Shutter
from geogs.cli.main import main
from geogs.config import Config
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.sniff import open_posed_source, open_source
from geogs.io.writers.intrinsics_file import write_intrinsics
from lenses import undistorted_rays
from saved_results import CAMERA, IDS, MASKED, make_result

LENSES = {
    "pinhole": Calibration(140.0, 140.0, 80.0, 58.0, (), 160, 120),
    "polynomial": Calibration(140.0, 141.0, 81.0, 58.0, (-0.12, 0.02, 0.001, 0.0), 160, 120),
    "fisheye": Calibration(90.0, 90.0, 79.0, 60.0, (0.02, -0.01, 0.0, 0.0), 160, 120,
                           lens="fisheye"),
}  # fmt: skip


def colour_of(rays: np.ndarray, number: int) -> np.ndarray:
    """A colour for each ray of an image: what the world looks like, whatever the camera."""
    x, y = rays[..., 0], rays[..., 1]
    waves = [np.sin(5 * x + number), np.sin(6 * y - number), np.sin(4 * (x + y))]
    return (128 + 90 * np.stack(waves, -1)).round().astype(np.uint8)


def write_source(folder: Path, lens: Calibration) -> Path:
    folder.mkdir()
    camera = Camera(lens.fx, lens.fy, lens.cx, lens.cy, 160, 120)
    v, u = np.mgrid[:120, :160]
    pixels = np.stack([u, v], -1).reshape(-1, 2).astype(float)
    rays = undistorted_rays(pixels, camera, lens.distortion, lens.lens).reshape(120, 160, 2)
    for number in range(max(IDS) + 1):
        path = str(folder / f"{number:04d}.png")
        cv2.imwrite(path, np.ascontiguousarray(colour_of(rays, number)[..., ::-1]))
    return folder


@pytest.fixture(params=LENSES)
def run_result(request, tmp_path) -> tuple[Path, Path]:
    """A result, and the images that a run would have made it from."""
    lens = LENSES[request.param]
    source = write_source(tmp_path / "images", lens)
    folder = make_result(tmp_path / "result")
    write_config(folder / "config.yaml", Config())
    write_intrinsics(folder / "intrinsics.json", CAMERA, lens, Shutter(0.0, "a test"))
    said = {"fingerprint": open_source(source).fingerprint(), "shutter": {"readout": 0.0}}
    (folder / "summary.json").write_text(json.dumps(said))
    return folder, source


@pytest.mark.parametrize("to", ["colmap", "nerfstudio"])
def test_exported_pixels_show_what_their_rays_meet(run_result, tmp_path, to):
    folder, source = run_result
    options = {"images": (str(source),), "points": 300, "as_tracked": True}
    out = export(ExportSettings(folder, to, tmp_path / "out", device="cpu", **options))
    found = open_posed_source(out)
    result = geogs.load_result(folder)
    np.testing.assert_allclose(found.T_cw, result.views.T_cw, atol=1e-9)
    assert found.camera.width > 1.3 * CAMERA.width
    for number, image in enumerate(found):
        camera = found.camera
        rays = camera.rays(torch.float64).numpy()[..., :2]
        expected = colour_of(rays, IDS[number]).astype(float)
        error = np.abs(image.image.astype(float) - expected)[4:-4, 4:-4]
        assert np.median(error) < 2
        assert np.quantile(error, 0.98) < 8
    masks = [image.mask is not None for image in found]
    assert masks == [i == MASKED for i in range(len(IDS))]


def test_points_are_seen_where_the_full_camera_projects_them(run_result, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    folder, source = run_result
    settings = ExportSettings(folder, "colmap", tmp_path / "out", images=(str(source),), points=300)
    model = pycolmap.Reconstruction(str(export(settings) / "sparse" / "0"))
    for point in list(model.points3D.values())[::20]:
        for seen in point.track.elements:
            image = model.images[seen.image_id]
            own = image.points2D[seen.point2D_idx]
            np.testing.assert_allclose(image.project_point(point.xyz), own.xy, atol=1e-3)


def test_the_list_of_exports_names_no_video(run_result):
    """What a list in a folder from elsewhere names would be opened."""
    folder, source = run_result
    export(ExportSettings(folder, "colmap", images=(str(source),), points=300, device="cpu"))
    with pytest.raises(InputError, match="was made with --images"):
        exports_of(folder, "cpu")


def test_other_images_are_refused_in_a_sentence(run_result, tmp_path, capsys):
    folder, source = run_result
    (source / "0003.png").write_bytes((source / "0004.png").read_bytes() + b"\0")
    start = ["export", str(folder), "--device", "cpu", "-o", str(tmp_path / "o")]
    assert main([*start, "--to", "colmap", "--images", str(source)]) == 2
    assert "read something else" in capsys.readouterr().err
    assert main([*start, "--to", "tum", "--images", str(source)]) == 2
    assert "--images is for colmap and nerfstudio" in capsys.readouterr().err
    (folder / "summary.json").write_text("{}")
    assert main([*start, "--to", "colmap", "--images", str(source)]) == 2
    assert "no result of geogs run" in capsys.readouterr().err
