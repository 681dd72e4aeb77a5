"""Rooms with known contents for the tests of the training data."""

import functools

import pytest
import torch

import geogs_synth.clips.clip_batch as clips_module
import geogs_synth.clips.sampler as sampler_module
import geogs_synth.raycast.cuda_caster as cuda_module
from cuda_emulator import use_emulator
from geogs_synth.camera.camera_batch import CameraBatch
from geogs_synth.scene.rooms import Lights, Rooms, Surfaces
from geogs_synth.scene.solids import NONE, SolidBatch, Solids
from geogs_synth.textures.bank import make_bank
from geogs_synth.textures.pyramids import TextureBank

bank_of = functools.cache(make_bank)


def use_fast_rooms(patch: pytest.MonkeyPatch) -> None:
    """Render with the emulated CUDA kernels, and draw each bank of textures once in a process."""
    use_emulator(patch, cuda_module)
    patch.setattr(sampler_module, "make_bank", bank_of)
    for module in (clips_module, sampler_module):
        patch.setattr(module, "caster_for", lambda _device: cuda_module.CudaCaster())


def solids_of(*rows: tuple[int, list[float], list[float], torch.Tensor | None]) -> SolidBatch:
    """One room's solids from kind, centre, half and rotation (none for upright)."""
    eye = torch.eye(3, dtype=torch.float64)
    return Solids(
        kind=torch.tensor([[r[0] for r in rows]]),
        rotation=torch.stack([eye if r[3] is None else r[3].double() for r in rows])[None],
        centre=torch.tensor([[r[1] for r in rows]], dtype=torch.float64),
        half=torch.tensor([[r[2] for r in rows]], dtype=torch.float64),
    )


def nothing() -> SolidBatch:
    return solids_of((NONE, [0, 0, 0], [1, 1, 1], None))


def room_of(solids: SolidBatch, views: int = 2) -> Rooms:
    """A plain lit room of 4 x 5 x 3 metres."""
    n = (1, 6 + 2 * solids.kind.shape[1])
    f = {"dtype": torch.float64}
    surfaces = Surfaces(
        texture=torch.arange(n[1])[None] % 2,
        matrix=torch.eye(2, **f).expand(*n, 2, 2),
        offset=torch.full((*n, 2), 0.3, **f),
        contrast=torch.full(n, 0.8, **f),
        tint=torch.full((*n, 3), 1.2, **f),
        noise=torch.ones(n, dtype=torch.int64),
        noise_scale=torch.full(n, 3.0, **f),
        detail=torch.full(n, 0.2, **f),
        gloss=torch.full(n, 0.2, **f),
        shininess=torch.full(n, 20.0, **f),
        glow=torch.full(n, 0.1, **f),
        mirror=torch.full(n, 0.3, **f),
    )
    lights = Lights(
        position=torch.tensor([2.0, 2.5, 2.8], **f).expand(1, views, 1, 3),
        colour=torch.full((1, views, 1, 3), 2.0, **f),
        radius=torch.full((1, views, 1), 0.1, **f),
        above=torch.full((1, views, 3), 0.4, **f),
        below=torch.full((1, views, 3), 0.2, **f),
    )
    return Rooms(torch.tensor([[4.0, 5.0, 3.0]], **f), solids, surfaces, lights)


def looking_along_y(*centres: list[float], width: int = 33, height: int = 25) -> CameraBatch:
    """Upright cameras that look along +y, focal length 30 pixels."""
    R = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    T = torch.eye(4, dtype=torch.float64).repeat(1, len(centres), 1, 1)
    T[..., :3, :3] = R
    T[..., :3, 3] = -torch.tensor(centres, dtype=torch.float64) @ R.T
    k = torch.tensor([[30.0, 30.0, (width - 1) / 2, (height - 1) / 2]], dtype=torch.float64)
    return CameraBatch(T, k, width, height)


def small_bank() -> TextureBank:
    g = torch.Generator().manual_seed(0)
    return TextureBank.pack(
        torch.randint(0, 255, (2, 16, 16, 3), generator=g, dtype=torch.uint8), 1
    )
