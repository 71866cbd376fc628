"""Keeps what was measured and fitted: published text files, observations, catalogue."""
