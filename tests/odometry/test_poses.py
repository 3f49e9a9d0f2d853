"""Poses and movements."""

import numpy as np
import pytest

from vinemap.odometry.poses import Pose, onward, onward_covariance


def test_covariance_goes_along_with_the_movement():
    rng = np.random.default_rng(2)
    pose, step = Pose(10.0, -20.0, 30.0), Pose(60.0, 5.0, 4.0)
    of_pose, of_step = np.diag([4.0, 1.0, 0.25]), np.diag([1.0, 2.0, 0.04])
    tried = [
        onward(Pose(*rng.multivariate_normal(pose, of_pose)), Pose(*rng.multivariate_normal(step, of_step)))
        for _ in range(4000)
    ]
    found = np.cov(np.array(tried).T)
    assert found == pytest.approx(onward_covariance(pose, of_pose, step, of_step), abs=0.35)
