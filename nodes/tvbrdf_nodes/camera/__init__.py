"""The camera: its node, the driver interface, real drivers, and the simulated camera."""
