"""Input and output of the depth network."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class StereoViews:
    """b keyframes with k neighbours each.

    Lengths may have any unit; it is the same for ``T_nk`` and the range. The network only sees
    lengths relative to ``typical``.
    """

    image: Float[Tensor, "b 3 h w"]
    """The keyframes, RGB in [0, 1]."""
    others: Float[Tensor, "b k 3 h w"]
    """The neighbours."""
    intrinsics: Float[Tensor, "b 4"]
    """fx fy cx cy of the keyframe in pixels, pixel centres at integers."""
    other_intrinsics: Float[Tensor, "b k 4"]
    T_nk: Float[Tensor, "b k 4 4"]
    """Transformation from the keyframe's camera to the neighbours'."""
    valid: Bool[Tensor, "b k"]
    """False for neighbours that only fill the batch."""
    near: Float[Tensor, "b"]
    """Nearest depth to search."""
    far: Float[Tensor, "b"]
    """Farthest depth to search."""
    typical: Float[Tensor, "b"]
    """Approximate median depth."""


@dataclass(frozen=True)
class DepthPrediction:
    """Prediction for keyframes; logarithms are of depth over ``typical``."""

    log_depth: Float[Tensor, "b h w"]
    """Mean logarithm of depth of every pixel."""
    log_scale: Float[Tensor, "b h w"]
    """Logarithm of the Laplace scale of the logarithm of depth of inliers."""
    outlier: Float[Tensor, "b h w"]
    """Logit of the probability that a pixel is an outlier, anywhere in the range."""
    normal: Float[Tensor, "b 3 h w"]
    """Unit, camera frame, facing the camera."""
    concentration: Float[Tensor, "b h w"]
    """Concentration of the angular von Mises-Fisher distribution around the normal."""
    at_half: Float[Tensor, "b h2 w2"]
    """``log_depth`` at 1/2; cell i covers the pixels 2 i and 2 i + 1."""
    at_quarter: Float[Tensor, "b h4 w4"]
    """``log_depth`` at 1/4 before it was refined."""
    tried: Float[Tensor, "b e h2 w2"]
    """The depths tried at 1/2, as ``log_depth``."""
    tried_logits: Float[Tensor, "b e h2 w2"]
    """Logits of the depths tried at 1/2."""
    plane_logits: Float[Tensor, "b d h4 w4"]
    """Logits of the planes at 1/4."""
    plane_scores: Float[Tensor, "b d h4 w4"]
    """Scores of the planes from the neighbours' features alone."""
    log_planes: Float[Tensor, "b d"]
    """Logarithms of the planes' depths over ``typical``."""

    def depth(self, typical: Float[Tensor, "b"]) -> Float[Tensor, "b h w"]:
        """Depth in the unit of ``typical``."""
        return self.log_depth.exp() * typical[:, None, None]

    def deviation(self) -> Float[Tensor, "b h w"]:
        """Standard deviation of the logarithm of depth (relative) of inliers."""
        return 2**0.5 * self.log_scale.exp()
