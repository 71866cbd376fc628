"""The HDR merger: joins what was seen when with where the light was when."""
