"""Camera motion while an image is taken: over the rolling shutter and over the exposure."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs_synth.clips.room_options import SHAKEN, STREET
from geogs_synth.draw import Draw

_ROTATION = (0.15, 2.5)
"""Rotation about each axis during the readout of an image, degrees."""
_TRANSLATION = (0.001, 0.02)
"""Translation along each axis during the readout, in rooms, metres."""
_DRIVE = (0.01, 0.06)
"""The same along the optical axis on a street, metres."""
_OFTEN = 0.4
"""Fraction of the clips of other kinds in which the camera moves, too."""


@dataclass(frozen=True)
class Shake:
    """Motion of v cameras in each of b clips; the unit of time is the readout of an image."""

    rate: Float[Tensor, "b v 6"]
    """Rotation vector and translation (metres), in the frame of the camera."""
    rolling: Float[Tensor, "b"]
    """1 where rows are read one after the other, 0 where all at once."""
    exposure: Float[Tensor, "b v"]
    """Exposure time of each row."""
    objects: Float[Tensor, "b"]
    """Ratio of the readout to the time from view to view, over which objects move."""

    @property
    def sweep(self) -> Float[Tensor, "b v 6"]:
        """Motion of the cameras from their first row to their last."""
        return self.rate * self.rolling[:, None, None]


def draw_shake(draw: Draw, kind: Int[Tensor, "b"], views: int) -> Shake:
    """Draw motion for shaken clips and for some of the kinds after it, none for usual ones."""
    b, n = len(kind), (len(kind), views)
    shaken = (kind == SHAKEN) | ((kind > SHAKEN) & draw.chance(_OFTEN, b))
    street = (kind == STREET)[:, None, None]

    def vary(size: Tensor) -> Tensor:
        """Random values of this size, similar in the views of a clip."""
        whole = 0.6 * draw.normal(1.0, b, 1, 3) + 0.8 * draw.normal(1.0, *n, 3)
        return size[:, None, None] * whole

    rotation = vary(draw.log_uniform(*_ROTATION, b) * (math.pi / 180))
    translation = vary(draw.log_uniform(*_TRANSLATION, b))
    ahead = draw.log_uniform(*_DRIVE, b)[:, None, None] * draw.uniform(0.8, 1.2, *n, 1)
    ahead = torch.nn.functional.pad(ahead, (2, 0)) + 0.2 * translation
    # Cars turn slowly.
    rotation = torch.where(street, 0.3 * rotation, rotation)
    translation = torch.where(street, ahead, translation)
    rate = torch.cat([rotation, translation], -1) * shaken[:, None, None]
    long = draw.log_uniform(0.1, 1.0, b, 1) * draw.uniform(0.7, 1.3, *n)
    return Shake(
        rate=rate,
        rolling=(shaken & draw.chance(0.8, b)).float(),
        exposure=long * (shaken & draw.chance(0.8, b))[:, None],
        objects=draw.log_uniform(0.02, 0.4, b),
    )
