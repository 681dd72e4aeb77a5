"""Records that travel to kernels as plain floats have the names and the order of the structs."""

import re
from enum import IntEnum
from pathlib import Path

import numpy as np
import pytest

import geogs
from geogs.config import LossConfig
from geogs.depth.confidence import ConfidenceWeights
from geogs.depth.cuda.classical import CompletionSettings
from geogs.depth.cuda.revision import CheckSettings
from geogs.geometry.camera import Camera
from geogs.losses.cuda.view_table import ViewField
from geogs.losses.cuda.window_losses import _Flags
from geogs.losses.kernel_settings import (
    PhotoSettings,
    SingleViewSettings,
    photo_settings,
    record,
    single_view_settings,
)

SOURCES = Path(geogs.__file__).parent
CAMERA = Camera(10.0, 11.0, 7.5, 3.5, 16, 8)


def fields_of(struct: str, source: str) -> list[tuple[str, str]]:
    """Types and names of the members of a struct, in order."""
    text = re.sub(r"//[^\n]*", "", (SOURCES / source).read_text())
    (body,) = re.findall(rf"struct {struct} \{{([^}}]*)\}};", text)
    members = []
    for line in filter(None, (part.strip() for part in body.split(";"))):
        kind, names = line.split(maxsplit=1)
        members += [(kind, name.strip()) for name in names.split(",")]
    return members


@pytest.mark.parametrize(
    ("record_type", "source"),
    [
        (SingleViewSettings, "losses/cuda/view_maps.cuh"),
        (PhotoSettings, "losses/cuda/view_maps.cuh"),
        (CompletionSettings, "depth/cuda/completion.cu"),
        (CheckSettings, "depth/cuda/reprojection.cu"),
        (ConfidenceWeights, "depth/cuda/refinement.cu"),
    ],
)
def test_a_record_has_the_names_of_its_struct(record_type: type, source: str) -> None:
    expected = [("float", name) for name in record_type._fields]
    assert fields_of(record_type.__name__, source) == expected


@pytest.mark.parametrize(
    ("names", "pattern", "source"),
    [
        (ViewField, r"enum ViewField \{([^}]*)\}", "losses/cuda/view_maps.cuh"),
        (_Flags, r"enum \{([^}]*)\}", "losses/cuda/windows.cuh"),
    ],
)
def test_an_enumeration_has_the_names_and_numbers_of_the_kernels(
    names: type[IntEnum], pattern: str, source: str
) -> None:
    (body,) = re.findall(pattern, (SOURCES / source).read_text())
    members: dict[str, int] = {}
    for k, part in enumerate(body.split(",")):
        name, _, number = (word.strip() for word in part.partition("="))
        members[name] = int(number) if number else k
    members.pop("VIEW_FIELDS", None)  # their number
    assert members == {member.name: member.value for member in names}


def test_compiled_code_gets_the_same_values_by_the_same_names() -> None:
    config = LossConfig(distortion_weight=0.3, l1_huber=0.0)
    single, photo = single_view_settings(config, CAMERA, 2.0), photo_settings(config, CAMERA, 0.5)
    assert single.distortion == pytest.approx(0.3 / 2 / 128)
    assert photo.l1 == pytest.approx(0.5 * config.l1_weight / 128)
    assert (photo.huber, photo.cut, single.relative) == (1e-9, config.l1_cut, 1)
    for settings in (single, photo):
        packed = record(settings)
        assert packed.dtype.names == settings._fields
        for name, value in settings._asdict().items():
            assert packed[name] == np.float32(value)
