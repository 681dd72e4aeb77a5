"""What a run tells of poses beside the images."""

from geogs.application.scale.apply import sentences_on_poses
from geogs.tracking.graph.measured_odometry import OdometryAgreement


def test_poses_that_do_not_fit_are_told():
    assert sentences_on_poses(OdometryAgreement(0, 0.0, False)) == []
    (used,) = sentences_on_poses(OdometryAgreement(20, 0.85, True))
    assert used == (
        "Poses beside the images: 85% of 20 motions between keyframes fit what the images show."
    )
    (refused,) = sentences_on_poses(OdometryAgreement(20, 0.05, False))
    assert refused.startswith("warning: the poses beside the images are not used: only 5% of 20")
