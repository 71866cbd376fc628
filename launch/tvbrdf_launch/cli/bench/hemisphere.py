"""How far a fitted BRDF is from another one, over all directions of light and view."""

from __future__ import annotations

import math

import numpy as np

from tvbrdf_fitting.error_measures import LOG_LARGEST_ANGLE_DEG
from tvbrdf_fitting.geometry import FloatArray
from tvbrdf_fitting.models import ReflectanceModel

SAMPLES = 4096
SMALLEST_THETA_H = 1e-3
SMALLEST_COSINE = math.cos(math.radians(LOG_LARGEST_ANGLE_DEG))


class Hemisphere:
    """Random pairs of directions with weights, the same for all fits of a model.

    The error of a BRDF is ``sqrt(int (f - g)^2 dm / int g^2 dm)`` with ``dm = cos(theta_i)
    cos(theta_r) domega_i domega_r``, and the mean over the channels in both integrals. Both angles
    are below 80 degrees: where light and view graze, Torrance-Sparrow's lobe grows without limit,
    and a few pairs would decide. Half of the pairs are uniform in that measure; in the other half
    the logarithm of the half vector's angle to the normal is, which finds lobes of any width. Each
    pair is weighted by its density in the two together (the balance heuristic of Veach and Guibas,
    SIGGRAPH 1995).
    """

    def __init__(self, model: ReflectanceModel, samples: int = SAMPLES) -> None:
        light, view = _pairs(np.random.default_rng(29), samples)
        self._model = model
        self._prepared = model.prepare(light, view)
        cosines = light[:, 2] * view[:, 2]
        self._weight = cosines / _density(light, view)

    def relative_error(self, internal: FloatArray, truth: FloatArray) -> float:
        """Root mean square difference of two sets of internal coordinates (p,), over the second."""
        true = self._model.value(self._prepared, truth)
        off = self._model.value(self._prepared, internal) - true
        size = float((self._weight * true * true).sum())
        return math.sqrt(float((self._weight * off * off).sum()) / size) if size > 0 else math.nan


def _pairs(rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray]:
    view, light = _cosine_weighted(rng, count), _cosine_weighted(rng, count)
    half = count // 2
    theta = np.exp(rng.uniform(math.log(SMALLEST_THETA_H), math.log(math.pi / 2), half))
    phi = rng.uniform(0.0, 2 * math.pi, half)
    h = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
    light[:half] = 2 * np.einsum("ij,ij->i", h, view[:half])[:, None] * h - view[:half]
    kept = np.minimum(light[:, 2], view[:, 2]) > SMALLEST_COSINE
    return light[kept], view[kept]


def _cosine_weighted(rng: np.random.Generator, count: int) -> FloatArray:
    radius, phi = np.sqrt(rng.random(count)), rng.uniform(0.0, 2 * math.pi, count)
    z = np.maximum(np.sqrt(1 - radius * radius), 1e-6)
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=1)


def _density(light: FloatArray, view: FloatArray) -> FloatArray:
    """Density of a pair, per solid angle squared, in the mixture of `_pairs`."""
    of_view = view[:, 2] / math.pi
    together = light + view
    length = np.linalg.norm(together, axis=1)
    theta = np.arctan2(np.hypot(together[:, 0], together[:, 1]), together[:, 2])
    theta = np.maximum(theta, 1e-9)
    of_h = (
        1
        / (2 * math.pi * np.sin(theta) * theta * math.log(math.pi / 2 / SMALLEST_THETA_H))
        * (theta >= SMALLEST_THETA_H)
    )
    # d omega_h / d omega_l = 1 / (4 v.h), and v.h = |l + v| / 2
    return np.asarray(of_view * 0.5 * (light[:, 2] / math.pi + of_h / (2 * length)))
