"""What is asked of the peers: residuals and derivatives of one scan, as fast as they can be had.

In numpy, on whole arrays, as a user of those libraries would write them; and compiled, so that a
peer's time is that of its algorithm. Both start from the same prepared geometry as our solver and
step in its coordinates: kd_b, kd_g, kd_r, sigma_d^2, ks, log(1/sigma_s). Only Oren-Nayar +
Torrance-Sparrow with a shared amplitude.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from tvbrdf_fitting.geometry import FloatArray
from tvbrdf_fitting.problem import Problem
from tvbrdf_fitting.solve.separable.elementary import JIT, exp_negative
from tvbrdf_fitting.solve.separable.layout import data_of, layout_of
from tvbrdf_launch.cli.bench.contestants import generic_start

PARAMETERS = 6
COMPILED: dict[str, Any] = {**JIT, "cache": False, "fastmath": {"contract", "reassoc", "nsz"}}
LARGEST_LOG = 300.0


class Residuals:
    """Weighted residuals (3 n,) and their derivatives, in numpy and compiled.

    Attributes
    ----------
    data
        vectors (3, n), f (n,), q (n,), radiance (3, n), weight (3, n).
    lower, upper
        (6,) bounds.
    start
        (6,) a sensible start for any scan: albedos from the mean radiance, everything else a guess.
    """

    def __init__(self, problem: Problem) -> None:
        layout = layout_of(problem.model)
        if layout is None or len(problem.free) != PARAMETERS:
            raise ValueError(f"{problem.model.name}: peers fit the six free parameters of ON+TS")
        self.problem = problem
        self.data = data_of(problem, layout)
        self.lower, self.upper = problem.lower.copy(), problem.upper.copy()
        self.start = generic_start(problem)
        self._columns = np.empty((PARAMETERS, *problem.radiance.shape))

    def residual(self, x: FloatArray) -> FloatArray:
        """Residuals (3 n,) in numpy."""
        vectors, f, q, radiance, weight = self.data
        c1, b, e, _, _, _ = _coefficients(x[3])
        kd = x[:3, None]
        lobe = np.exp(q * -math.exp(2 * min(x[5], LARGEST_LOG)))
        lobe *= f * x[4]
        out = kd * (c1 * vectors[0] + b * vectors[1])
        out += (kd * kd) * (e * vectors[2])
        out += lobe
        out -= radiance
        out *= weight
        return np.asarray(out.ravel())

    def columns(self, x: FloatArray) -> FloatArray:
        """Derivatives (6, 3 n) in numpy; a new call overwrites them."""
        vectors, f, q, _, weight = self.data
        c1, b, e, slope_c1, slope_b, slope_e = _coefficients(x[3])
        out = self._columns
        scaled = q * math.exp(2 * min(x[5], LARGEST_LOG))
        lobe = np.exp(-scaled)
        lobe *= f
        single, multiple = c1 * vectors[0] + b * vectors[1], (2 * e) * vectors[2]
        slope, slope_multiple = slope_c1 * vectors[0] + slope_b * vectors[1], slope_e * vectors[2]
        for c in range(3):
            kd = x[c]
            out[c] = 0.0
            np.multiply(single + kd * multiple, weight[c], out=out[c, c])
            np.multiply(kd * slope + (kd * kd) * slope_multiple, weight[c], out=out[3, c])
        np.multiply(weight, lobe, out=out[4])
        np.multiply(weight, (-2 * x[4]) * scaled * lobe, out=out[5])
        return out.reshape(PARAMETERS, -1)

    def jacobian(self, x: FloatArray) -> FloatArray:
        """Derivatives (3 n, 6) in numpy, of Fortran's order; a new call overwrites them."""
        return self.columns(x).T

    def compiled_residual(self, x: FloatArray) -> FloatArray:
        """Residuals (3 n,) by compiled code."""
        out = np.empty(self.problem.radiance.shape)
        write_residual(x, *self.data, out)
        return out.ravel()

    def compiled_columns(self, x: FloatArray) -> FloatArray:
        """Derivatives (6, 3 n) by compiled code; a new call overwrites them."""
        write_columns(x, *self.data, self._columns)
        return self._columns.reshape(PARAMETERS, -1)

    def compiled_jacobian(self, x: FloatArray) -> FloatArray:
        """Derivatives (3 n, 6) by compiled code, of Fortran's order; a new call overwrites them."""
        return self.compiled_columns(x).T

    def cost(self, x: FloatArray) -> float:
        """Half the sum of squared residuals; infinite outside the bounds."""
        slack = 1e-9 * np.maximum(1.0, np.abs(x))
        if not ((x >= self.lower - slack) & (x <= self.upper + slack)).all():
            return math.inf
        return self.problem.cost(self.problem.clamp(x))


@njit(**COMPILED)
def _coefficients(s):  # type: ignore[no-untyped-def]
    if s < 0:  # where an unbounded solver may step: the tangents
        return 1 - 0.5 * s / 0.33, s / 0.09, 0.17 * s / 0.13, -0.5 / 0.33, 1 / 0.09, 0.17 / 0.13
    return (
        1 - 0.5 * s / (s + 0.33),
        s / (s + 0.09),
        0.17 * s / (s + 0.13),
        -0.5 * 0.33 / (s + 0.33) ** 2,
        0.09 / (s + 0.09) ** 2,
        0.17 * 0.13 / (s + 0.13) ** 2,
    )


@njit(**COMPILED)
def write_residual(x, vectors, f, q, radiance, weight, out):  # type: ignore[no-untyped-def]
    """Write residuals (3, n)."""
    c1, b, e, _, _, _ = _coefficients(x[3])
    scale, ks = math.exp(2 * min(x[5], LARGEST_LOG)), x[4]
    lobe = np.empty(f.shape[0])
    for i in range(f.shape[0]):
        lobe[i] = ks * f[i] * exp_negative(q[i] * scale)
    for c in range(3):
        kd = x[c]
        own, w, y = out[c], weight[c], radiance[c]
        for i in range(f.shape[0]):
            diffuse = c1 * vectors[0, i] + b * vectors[1, i] + kd * e * vectors[2, i]
            own[i] = w[i] * (kd * diffuse + lobe[i] - y[i])


@njit(**COMPILED)
def write_columns(x, vectors, f, q, radiance, weight, out):  # type: ignore[no-untyped-def]
    """Write derivatives (6, 3, n)."""
    c1, b, e, slope_c1, slope_b, slope_e = _coefficients(x[3])
    scale, ks = math.exp(2 * min(x[5], LARGEST_LOG)), x[4]
    n = f.shape[0]
    lobe, slope = np.empty(n), np.empty(n)
    for i in range(n):
        exponent = q[i] * scale
        lobe[i] = f[i] * exp_negative(exponent)
        slope[i] = -2 * ks * min(exponent, 1e3) * lobe[i]
    for c in range(3):
        kd, w = x[c], weight[c]
        for other in range(3):
            out[other, c] = 0.0
        for i in range(n):
            single = c1 * vectors[0, i] + b * vectors[1, i]
            out[c, c, i] = w[i] * (single + 2 * kd * e * vectors[2, i])
            by_s = slope_c1 * vectors[0, i] + slope_b * vectors[1, i]
            out[3, c, i] = w[i] * kd * (by_s + kd * slope_e * vectors[2, i])
            out[4, c, i] = w[i] * lobe[i]
            out[5, c, i] = w[i] * slope[i]


@njit(**COMPILED)
def write_rows(x, vectors, f, q, radiance, weight, out, columns):  # type: ignore[no-untyped-def]
    """Write derivatives (3 n, 6) row by row, as C libraries want them; `columns` is overwritten."""
    write_columns(x, vectors, f, q, radiance, weight, columns)
    n = f.shape[0]
    for c in range(3):
        for i in range(n):
            for k in range(6):
                out[c * n + i, k] = columns[k, c, i]
