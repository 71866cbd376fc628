"""Pairs of light and view that are hard for formulas of reflectance, and some that are not."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from tvbrdf_fitting.geometry import FloatArray, view_direction


def direction(cosine: float, azimuth: float) -> FloatArray:
    """Return the unit vector (3,) of a cosine to the normal, exact as given, and an azimuth."""
    sine = np.sqrt((1 - cosine) * (1 + cosine))
    return np.array([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine])


@lru_cache(maxsize=1)
def hard_directions() -> tuple[FloatArray, FloatArray]:
    """Return light and view (n, 3), n = 235, that are hard for formulas of reflectance."""
    pairs = [*_grazing(), *_normal(), *_retro_and_mirror(), *_azimuths(), *_generic()]
    light, view = (np.array(vectors) for vectors in zip(*pairs, strict=True))
    for array in (light, view):
        array.setflags(write=False)
    return light, view


def every(step: int, start: int = 0) -> tuple[FloatArray, FloatArray]:
    """Return each `step`-th of the hard directions, for references that are slow."""
    light, view = hard_directions()
    return light[start::step], view[start::step]


def ordinary_directions() -> tuple[FloatArray, FloatArray]:
    """Return the 36 of the hard directions that are not hard: at random, cosines above 0.02."""
    light, view = hard_directions()
    return light[-36:], view[-36:]


_Pairs = list[tuple[FloatArray, FloatArray]]
_TURNS = (0.0, 1e-9, 0.7, np.pi / 2 - 1e-9, np.pi / 2, 2.3, np.pi - 1e-4, np.pi - 1e-9, np.pi)


def _grazing() -> _Pairs:
    pairs = []
    steep = (1e-12, 1e-8, 1e-4, 1e-2)
    cosines = [(a, a) for a in steep] + [(1e-12, 3e-12), (1e-8, 1.7e-6)]
    cosines += [(a, b) for a in steep for b in (0.45, 0.97)]
    for index, (one, other) in enumerate(cosines):
        turns = _TURNS if one * other < 1e-7 else _TURNS[index % 2 :: 2]
        for number, turn in enumerate(turns):
            start = 0.0 if number % 3 == 0 else 0.4 + number
            pair = direction(one, start), direction(other, start + turn)
            pairs.append(pair if (index + number) % 2 else pair[::-1])
    return pairs


def _normal() -> _Pairs:
    """Return the normal, and what is nearly the normal: azimuth undefined or nearly so."""
    normal = np.array([0.0, 0.0, 1.0])
    others = [direction(cosine, 0.9) for cosine in (0.97, 0.5, 1e-3, 1e-12)]
    nearly = [np.array([1e-9, 0.0, 1.0]), np.array([-3e-5, 2e-5, 1 - 6.5e-10])]
    pairs = [(normal, normal), (nearly[0], nearly[0]), (nearly[0], nearly[1])]
    for vector in (normal, *nearly):
        pairs += [(vector, other) for other in others] + [(other, vector) for other in others]
    return pairs


def _retro_and_mirror() -> _Pairs:
    pairs = []
    for index, cosine in enumerate((0.99, 0.8, 0.5, 0.1, 1e-3, 1e-7, 1e-12)):
        light = direction(cosine, 0.6 * index)
        mirrored = light * (-1, -1, 1)
        pairs += [(light, light), (light, mirrored)]
        for turn, factor in ((1e-9, 1.0), (0.0, 1 + 1e-6)):
            off = direction(min(cosine * factor, 1.0), 0.6 * index + turn)
            pairs += [(light, off), (light, off * (-1, -1, 1))]
    return pairs


def _azimuths() -> _Pairs:
    pairs = []
    for one, other in ((0.3, 0.8), (0.75, 0.7499999), (0.9, 0.05)):
        for middle in (0.0, np.pi / 2, np.pi):
            for offset in (-1e-9, 0.0, 1e-9):
                start = 0.0 if offset == 0 else 1.1
                pairs.append((direction(one, start), direction(other, start + middle + offset)))
    return pairs


def _generic() -> _Pairs:
    rng = np.random.default_rng(11)
    views = [view_direction(angle) for angle in (0.0, 25.0, 50.0, 75.0)]
    views += [direction(z, turn) for z, turn in rng.uniform((0.02, -3), (1, 3), (32, 2))]
    return [(direction(rng.uniform(0.02, 1), rng.uniform(-3, 3)), view) for view in views]
