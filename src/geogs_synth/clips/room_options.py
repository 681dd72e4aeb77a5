"""Options of the random rooms and of the clips filmed in them."""

from dataclasses import dataclass, fields
from typing import Annotated

from geogs.config.setting import Count, Fraction, Range, Settings, Weight


@dataclass(frozen=True)
class MotionWeights(Settings, group="training.rooms.motions"):
    """Relative frequencies of the kinds of camera motion from view to view."""

    hand_held: Weight = 0.25
    """Frequency of motions by 2 to 15 cm and a few degrees."""
    medium: Weight = 0.30
    """Frequency of motions by 15 to 50 cm."""
    wide: Weight = 0.20
    """Frequency of motions by 50 cm to 1.2 m that rotate to keep a point in view."""
    rotation: Weight = 0.10
    """Frequency of rotations by up to 20 degrees about each axis, without translation."""
    forward: Weight = 0.15
    """Frequency of motions by 10 to 80 cm forwards or backwards."""


@dataclass(frozen=True)
class SceneWeights(Settings, group="training.rooms.scenes"):
    """Relative frequencies of the kinds of scenes."""

    usual: Weight = 1.0
    """Frequency of static rooms, seen with a short exposure and a global shutter."""
    shaken: Weight = 0.0
    """Frequency of static rooms, seen with a rolling shutter and motion blur."""
    people: Weight = 0.0
    """Frequency of rooms with walking people."""
    papered: Weight = 0.0
    """Frequency of rooms whose walls repeat one pattern exactly."""
    bare: Weight = 0.0
    """Frequency of rooms with hardly any texture."""
    street: Weight = 0.0
    """Frequency of streets with moving cars and people, seen by a driver or a pedestrian."""


USUAL, SHAKEN, PEOPLE, PAPERED, BARE, STREET = range(6)
SCENE_KINDS = tuple(field.name for field in fields(SceneWeights))
"""Names of the kinds of scenes, by their numbers."""


def only_scene(name: str) -> SceneWeights:
    """Scenes of one kind."""
    return SceneWeights(**{kind: float(kind == name) for kind in SCENE_KINDS})


@dataclass(frozen=True)
class RoomOptions(Settings, group="training.rooms"):
    """Size and variety of the random rooms and of the clips filmed in them."""

    width: Annotated[int, Range(16, 8192)] = 512
    """Width of the images, pixels."""
    height: Annotated[int, Range(16, 8192)] = 384
    """Height of the images, pixels."""
    views: Annotated[int, Range(2, 100)] = 2
    """Number of views per clip; more than 2 follow a smooth path."""
    least_density: Fraction = 0.12
    """Least fraction of the roughly 125 slots for solids that a room fills."""
    most_density: Annotated[float, Range("least_density", 1)] = 0.5
    """Largest fraction of the slots for solids that a room fills."""
    thin: Fraction = 0.0
    """Largest fraction of the slots for thin things (railings, lattices, cables, twigs, chairs)
    that a room fills."""
    motions: MotionWeights = MotionWeights()
    """Kinds of camera motion."""
    scenes: SceneWeights = SceneWeights()
    """Kinds of scenes. Streets have motions of their own. Of the clips of people, papered and bare
    rooms and streets, two fifths have a rolling shutter or motion blur, too."""
    sway: Weight = 0.0
    """Standard deviation of the views of longer clips from a smooth path, over the step length."""
    candidates: Count = 24
    """Number of random camera paths per clip, of which the first suitable one is taken."""
    disturbance: Weight = 1.0
    """Strength of noise, blur, artefacts and exposure changes; 0 leaves the images clean."""
    clean: Fraction = 0.3
    """Fraction of the clips with nearly clean images."""
    light_change: Fraction = 0.15
    """Fraction of the clips whose light changes between the views."""
    textures: Count = 256
    """Number of textures in the bank."""
    texture_size: Annotated[int, Range(2, 8192)] = 512
    """Side of the square textures, texels; a power of two."""
    validation: bool = False
    """Whether to use the rooms and textures of the validation, which training never sees."""
