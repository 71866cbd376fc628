"""What all nodes share: the node class, the two shells, drivers, parameters."""
