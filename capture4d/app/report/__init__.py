"""Pages and metrics: of a take, an animation, a calibration, a check."""
