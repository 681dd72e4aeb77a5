"""DTU as prepared for IDR: ``cameras.npz`` with projection matrices, ``image/`` and ``mask/``.

``world_mat_i`` is K [R|t] of image i in the millimetres of the data set; ``scale_mat_i`` maps the
unit ball, in which the object lies, into them. Yariv et al., "Multiview neural surface
reconstruction by disentangling geometry and appearance", NeurIPS 2020.
"""

import re
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64

from geogs.errors import InputError
from geogs.guard.documents import open_file
from geogs.io.pose_files import FRAMES_PER_SECOND
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.formats.image_files import SUFFIXES, natural_key
from geogs.io.sources.posed.posed_set import PosedFile, PosedSet
from geogs.io.sources.posed.stored_pictures import has_alpha

MAX_SKEW = 0.5
"""Largest skew that is neglected, in pixels across the image."""


def is_dtu(folder: Path) -> bool:
    """Whether ``folder`` holds cameras and images."""
    return _cameras(folder).is_file()


def open_dtu(folder: Path) -> PosedSet:
    """Read a scan; the world is that of the data set (millimetres in DTU)."""
    world, scale = _read_matrices(_cameras(folder))
    images = _pictures(folder, ("image", "images", "rgb"))
    masks = _pictures(folder, ("mask", "masks"))
    if len(images) <= max(world):
        raise InputError(
            f"{folder} has {len(images)} images but {_cameras(folder).name} holds {len(world)} "
            f"cameras, the last of number {max(world)}; complete the images."
        )
    by_number = {_number(path): path for path in masks}
    decomposed = [decompose(matrix[:3]) for matrix in world.values()]
    calibrations = _calibrations([K for K, _ in decomposed], folder)
    files = []
    for k, index in enumerate(world):
        path = images[index]
        mask = masks[index] if len(masks) == len(images) else by_number.get(_number(path))
        if mask is None and has_alpha(path):
            mask = path
        time = index / FRAMES_PER_SECOND
        files.append(PosedFile(path, decomposed[k][1], calibrations[k], mask, time))
    return PosedSet("dtu", folder.resolve().name, tuple(files), _unit(folder, scale))


def decompose(
    P: Float64[np.ndarray, "3 4"],
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "4 4"]]:
    """K and world to camera of a projection matrix, of whatever scale and sign.

    K has a positive diagonal and 1 at the bottom; NaN throughout where there is no such camera.
    """
    T_cw = np.eye(4)
    if not np.isfinite(P).all() or abs(np.linalg.det(P[:, :3])) == 0:
        return np.full((3, 3), np.nan), np.full((4, 4), np.nan)
    P = P * np.sign(np.linalg.det(P[:, :3]))
    K, R = cv2.RQDecomp3x3(P[:, :3])[1:3]
    signs = np.sign(np.diag(K))
    K = K * signs
    R = signs[:, None] * R
    T_cw[:3, :3] = R
    try:
        T_cw[:3, 3] = np.linalg.solve(K, P[:, 3])
    except np.linalg.LinAlgError:
        return np.full((3, 3), np.nan), np.full((4, 4), np.nan)
    return K / K[2, 2], T_cw


def _cameras(folder: Path) -> Path:
    """The file of the cameras; NeuS uses another name."""
    sphere = folder / "cameras_sphere.npz"
    return sphere if sphere.is_file() else folder / "cameras.npz"


def _read_matrices(
    path: Path,
) -> tuple[dict[int, Float64[np.ndarray, "4 4"]], Float64[np.ndarray, "4 4"] | None]:
    """``world_mat_i`` by i, in order, and the first ``scale_mat_i`` if there is one."""
    try:
        with open_file(path) as stream, np.load(stream) as archive:
            matrices = {name: archive[name].astype(np.float64) for name in archive.files}
    except Exception as error:  # errors of zipfile, zlib or numpy for a damaged archive
        raise InputError(f"{path} is damaged or no NumPy archive; copy it again.") from error
    found = (re.fullmatch(r"world_mat_(0|[1-9][0-9]{0,8})", name) for name in matrices)
    numbers = sorted(int(match[1]) for match in found if match)
    shapes = {matrices[f"world_mat_{i}"].shape for i in numbers}
    scale = matrices.get(f"scale_mat_{numbers[0]}") if numbers else None
    if not numbers or not shapes <= {(3, 4), (4, 4)}:
        raise InputError(f"{path} holds no world_mat_0, world_mat_1, ... of 4x4 numbers.")
    if scale is not None and not (scale.shape == (4, 4) and np.isfinite(scale).all()):
        raise InputError(f"{path} holds a scale_mat_{numbers[0]} that is not of 4x4 numbers.")
    return {i: matrices[f"world_mat_{i}"] for i in numbers}, scale


def _calibrations(Ks: list[Float64[np.ndarray, "3 3"]], folder: Path) -> list[Calibration | None]:
    """A camera for each image; one for all where they differ only by rounding."""
    stack = np.stack(Ks)
    common = np.nanmedian(stack, axis=0)
    # The files hold single precision, which leaves a few thousandths of a pixel.
    if np.nanmax(np.abs(stack - common)) < 0.02 and not np.isnan(common).any():
        Ks = [common if np.isfinite(K).all() else K for K in Ks]
    return [_calibration(K, folder) if np.isfinite(K).all() else None for K in Ks]


def _calibration(K: Float64[np.ndarray, "3 3"], folder: Path) -> Calibration:
    if abs(K[0, 1] / K[1, 1]) * 2 * K[1, 2] > MAX_SKEW:
        raise InputError(
            f"The cameras in {_cameras(folder)} have a skew of {K[0, 1]:.3g} pixels, which "
            f"is not supported; is the order of the matrix right?"
        )
    return Calibration(
        float(K[0, 0]),
        float(K[1, 1]),
        float(K[0, 2]) - 0.5,
        float(K[1, 2]) - 0.5,
        origin=str(_cameras(folder)),
    )


def _pictures(folder: Path, names: tuple[str, ...]) -> list[Path]:
    for name in names:
        if (folder / name).is_dir():
            paths = [p for p in (folder / name).iterdir() if p.suffix.lower() in SUFFIXES]
            return sorted(paths, key=lambda path: natural_key(path.name))
    return []


def _number(path: Path) -> int | str:
    digits = re.findall(r"\d+", path.stem)
    return int(digits[-1]) if digits else path.stem


def _unit(folder: Path, scale: Float64[np.ndarray, "4 4"] | None) -> str:
    is_dtu_scan = re.fullmatch(r"(dtu_)?scan\d+", folder.resolve().name) is not None
    return "millimetres" if is_dtu_scan and scale is not None and scale[0, 0] > 50 else "arbitrary"
