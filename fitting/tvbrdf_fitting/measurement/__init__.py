"""From frames to radiance: calibration, where the light was, merging of exposures."""
