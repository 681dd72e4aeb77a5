"""Options of the random rooms and of the clips filmed in them."""

from dataclasses import dataclass, fields
from typing import Annotated

from geogs.config.setting import Count, Fraction, Range, Settings, Weight


@dataclass(frozen=True)
class MotionWeights(Settings, group="training.rooms.motions"):
    """Relative frequency of the kinds of camera motion."""

    hand_held: Weight = 0.25
    """2 to 15 cm and a few degrees."""
    medium: Weight = 0.30
    """15 to 50 cm."""
    wide: Weight = 0.20
    """50 cm to 1.2 m, turning so that roughly the same point stays in view."""
    rotation: Weight = 0.10
    """Up to 25 degrees about the camera's centre."""
    forward: Weight = 0.15
    """10 to 80 cm along the optical axis, either way."""


@dataclass(frozen=True)
class SceneWeights(Settings, group="training.rooms.scenes"):
    """Relative frequency of the kinds of scenes."""

    usual: Weight = 1.0
    """A still room, seen by a camera whose shutter opens for a moment."""
    shaken: Weight = 0.0
    """The same with a camera that moves while it looks: rolling shutter, motion blur."""
    people: Weight = 0.0
    """People walk from view to view."""
    papered: Weight = 0.0
    """Walls that repeat one pattern exactly."""
    bare: Weight = 0.0
    """Next to no texture."""
    street: Weight = 0.0
    """Houses along a road, with cars and people that move, seen by who drives, walks or turns."""


USUAL, SHAKEN, PEOPLE, PAPERED, BARE, STREET = range(6)
SCENE_KINDS = tuple(field.name for field in fields(SceneWeights))
"""Names of the kinds of scenes, by their numbers."""


def only_scene(name: str) -> SceneWeights:
    """Scenes of one kind."""
    return SceneWeights(**{kind: float(kind == name) for kind in SCENE_KINDS})


@dataclass(frozen=True)
class RoomOptions(Settings, group="training.rooms"):
    """Size and variety of the clips; the defaults are those that the network is trained with."""

    width: Annotated[int, Range(16, 8192)] = 512
    """Width of the images, pixels."""
    height: Annotated[int, Range(16, 8192)] = 384
    """Height of the images, pixels."""
    views: Annotated[int, Range(2, 100)] = 2
    """Per clip; 2 makes pairs, more make short smooth paths."""
    least_density: Fraction = 0.12
    """Least fraction of the places for solids that a room fills (there are about 125)."""
    most_density: Annotated[float, Range("least_density", 1)] = 0.5
    """Largest fraction of them."""
    thin: Fraction = 0.0
    """Largest fraction of the places for thin things that a room fills: railings, lattices,
    cables, twigs, chairs."""
    motions: MotionWeights = MotionWeights()
    """Kinds of camera motion."""
    scenes: SceneWeights = SceneWeights()
    """Kinds of scenes. All but the usual ones, and the streets, are rooms with those motions; in
    two fifths of them the camera moves while it looks, too."""
    sway: Weight = 0.0
    """Deviation of the views of longer clips from their path, over the way from view to view."""
    candidates: Count = 24
    """Camera paths tried per clip; the first that suits is taken."""
    disturbance: Weight = 1.0
    """Strength of noise, blur, artefacts and changes of exposure; 0 leaves the images clean."""
    clean: Fraction = 0.3
    """Fraction of the clips that are nearly undisturbed."""
    light_change: Fraction = 0.15
    """Fraction of the clips whose light changes between the views."""
    textures: Count = 256
    """Images in the texture bank."""
    texture_size: Annotated[int, Range(2, 8192)] = 512
    """Side of a texture, texels; a power of two."""
    validation: bool = False
    """Other rooms and other textures, never seen in training."""
