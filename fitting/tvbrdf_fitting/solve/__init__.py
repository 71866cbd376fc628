"""Solvers of one fit: the separable one, the general one, the independent ones, robust losses."""
