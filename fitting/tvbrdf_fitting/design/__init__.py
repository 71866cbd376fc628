"""The fewest lights, cameras and exposures for a wanted accuracy."""
