"""What the random rooms and the clips filmed in them are like."""

from dataclasses import dataclass


@dataclass(frozen=True)
class MotionShares:
    """Relative frequency of the kinds of camera motion."""

    hand_held: float = 0.25
    """2 to 15 cm and a few degrees."""
    medium: float = 0.30
    """15 to 50 cm."""
    wide: float = 0.20
    """50 cm to 1.2 m, turning so that roughly the same point stays in view."""
    rotation: float = 0.10
    """Up to 25 degrees about the camera's centre."""
    forward: float = 0.15
    """10 to 80 cm along the optical axis, either way."""


@dataclass(frozen=True)
class RoomOptions:
    """Size and variety of the clips; the defaults are those that the network is trained with."""

    width: int = 512
    """Of the images, pixels."""
    height: int = 384
    """Of the images, pixels."""
    views: int = 2
    """Per clip; 2 makes pairs, more make short smooth paths."""
    least_density: float = 0.12
    """Least share of the places for solids that a room fills (there are about 125)."""
    most_density: float = 0.5
    """Largest share of them."""
    motions: MotionShares = MotionShares()
    """Kinds of camera motion."""
    candidates: int = 24
    """Camera paths tried per clip; the first that suits is taken."""
    disturbance: float = 1.0
    """Strength of noise, blur, artefacts and changes of exposure; 0 leaves the images clean."""
    clean: float = 0.3
    """Share of the clips that are nearly undisturbed."""
    light_change: float = 0.15
    """Share of the clips whose light changes between the views."""
    textures: int = 256
    """Images in the texture bank."""
    texture_size: int = 512
    """Side of a texture, texels; a power of two."""
    validation: bool = False
    """Other rooms and other textures, never seen in training."""
