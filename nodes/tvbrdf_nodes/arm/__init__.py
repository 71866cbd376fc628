"""The arm: moves the light on its half circle, behind a serial line."""
