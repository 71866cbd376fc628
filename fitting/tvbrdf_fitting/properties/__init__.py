"""Properties of a model: reciprocity, albedos, where it creates energy."""
