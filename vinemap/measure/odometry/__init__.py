"""``make odometry``: errors, drift and lost steps of odometry on simulated frames."""
