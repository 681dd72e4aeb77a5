"""What parts match, and what the rows of their keyframes were off by."""

import numpy as np
import pytest
import torch

from geogs.application.results.saved_result import load_result
from geogs.camera.shutter.rows import CELL
from geogs.config import Config
from geogs.geometry.lie import se3_inverse, sim3_scale
from geogs.io.writers.keyframe_folder import rows_path, write_rows
from geogs.tracking.frames.row_errors import RowErrors
from geogs.types import SeenRows
from geogs.world.edges import position_step, unpacked_positions
from geogs.world.grid import SampleGrid
from geogs_fleet.join.matches import Matches, Member, match
from geogs_fleet.join.part import Part, PartViews, describe
from geogs_fleet.join.records import read_record
from joined_parts import CAMERA, FRAMES, gauge, make_part

GRID, CONFIG = SampleGrid(CAMERA), Config()
PLACES = np.linspace(-0.6, 0.2, 5)
READOUT = 0.03


def rows() -> SeenRows:
    """Times of rows that were taken for those of a camera that stands still."""
    height, width = -(-CAMERA.height // CELL) + 2, -(-CAMERA.width // CELL) + 2
    line = (torch.arange(height) - 1) * CELL + (CELL - 1) / 2
    seconds = READOUT * (line / (CAMERA.height - 1) - 0.5)
    offset = torch.zeros(height, width, 2)
    return SeenRows(offset.half(), seconds[:, None].expand(height, width).half().contiguous())


def matched(folder, number: int, with_rows: bool) -> tuple[Member, Matches]:
    """The matches of one part, in the world of the box, whatever its own."""
    part = Part(folder.name, make_part(folder, PLACES, number))
    if with_rows:
        write_rows(rows_path(folder), dict.fromkeys(range(len(PLACES)), rows()))
    views = folder / "views.safetensors"
    describe(part, CAMERA, views)
    S = gauge(number)
    T = torch.from_numpy(read_record(PartViews, views).T_cw) @ S
    scale = sim3_scale(T)
    T_cw = T / scale[:, None, None]
    T_cw[:, 3] = T[:, 3]
    member, file = Member(number, part, views, T_cw, scale), folder / "matches.safetensors"
    done = match(member, (), CAMERA, CONFIG, (), (file,))
    found = read_record(Matches, file)
    assert done.fresh == len(found.ends) // 2 > 5
    return member, found


@pytest.fixture(scope="module")
def corrected(tmp_path_factory) -> tuple[Member, Matches]:
    return matched(tmp_path_factory.mktemp("corrected") / "a", 0, with_rows=True)


def test_rows_are_corrected_as_within_a_run(corrected):
    member, found = corrected
    result = load_result(member.part.folder)
    frames = range(len(result.trajectory.timestamps))
    middle = [FRAMES * n + 1 for n in range(len(PLACES))]
    errors = RowErrors(GRID, dict.fromkeys(middle, rows()), frames, result.trajectory)
    source, target = found.ends[:, 1], found.ends[:, 3]
    T, depth = member.T_cw, member.depths().inverse
    plain = [
        unpacked_positions(GRID, edge.position) for edge in found.edges(as_found=True).values()
    ]
    shift = errors.of_matches(
        [middle[n] for n in source], [middle[n] for n in target],
        T[target] @ se3_inverse(T[source]), GRID.rays, depth[source], torch.stack(plain),
    ).shift  # fmt: skip
    step = position_step(CAMERA)
    assert float(shift.norm(dim=-1).median()) > 0.05  # pixels
    assert np.array_equal(found.shift, (shift / step).round().short().numpy())
    moved = torch.stack(
        [unpacked_positions(GRID, edge.position) for edge in found.edges().values()]
    )
    assert float((moved - torch.stack(plain) - shift).abs().max()) < 0.51 * step


def test_rows_are_corrected_in_any_world_and_unit(corrected, tmp_path):
    _, found = corrected
    _, other = matched(tmp_path / "b", 3, with_rows=True)
    assert np.array_equal(found.ends[:, [1, 3]], other.ends[:, [1, 3]])
    size = np.median(np.abs(found.shift[..., 0]))
    apart = np.abs(found.shift.astype(int) - other.shift)
    assert np.median(apart) < 0.02 * size


def test_nothing_is_shifted_where_no_rows_were_rectified(tmp_path):
    _, found = matched(tmp_path / "a", 0, with_rows=False)
    assert len(found.shift) == 0
    for edge, plain in zip(found.edges().values(), found.position, strict=True):
        assert np.array_equal(edge.position.numpy(), plain)
