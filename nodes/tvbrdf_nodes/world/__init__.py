"""The simulated world: the scene, and the clock that all simulated devices share."""
