"""Least squares problems with known minima, their exact Jacobians, and a measure of optimality."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from tvbrdf_fitting.solve.levenberg_marquardt import LeastSquaresSolution, levenberg_marquardt

Array = np.ndarray[Any, Any]
Function = Callable[[Array], Array]


def complex_step(residual: Function) -> Function:
    """Return the exact Jacobian of a residual that takes complex numbers."""

    def jacobian(x: Array) -> Array:
        columns = []
        for i in range(x.size):
            shifted = x.astype(complex)
            shifted[i] += 1e-150j
            columns.append(residual(shifted).imag / 1e-150)
        return np.stack(columns, axis=1)

    return jacobian


def solve(residual: Function, start: Any, **options: Any) -> LeastSquaresSolution:
    return levenberg_marquardt(residual, complex_step(residual), start, **options)


def slope(solution: LeastSquaresSolution) -> Array:
    """Cosines between the columns and the residual, which are 0 at a free minimum."""
    size = np.linalg.norm(solution.jacobian, axis=0) * np.linalg.norm(solution.residual)
    return np.asarray(solution.jacobian.T @ solution.residual / size)


# ---- known minima: J. J. More, B. S. Garbow, K. E. Hillstrom, "Testing unconstrained optimization
# software", ACM Transactions on Mathematical Software 7 (1981), 17-41. Sums of squares as printed
# there, to 6 digits; 0 where the residual vanishes.


def rosenbrock(x: Array) -> Array:
    return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def freudenstein_roth(x: Array) -> Array:
    return np.array(
        [
            -13 + x[0] + ((5 - x[1]) * x[1] - 2) * x[1],
            -29 + x[0] + ((x[1] + 1) * x[1] - 14) * x[1],
        ]
    )


def brown_badly_scaled(x: Array) -> Array:
    return np.array([x[0] - 1e6, x[1] - 2e-6, x[0] * x[1] - 2])


def beale(x: Array) -> Array:
    powers = np.arange(1, 4)
    return np.asarray(np.array([1.5, 2.25, 2.625]) - x[0] * (1 - x[1] ** powers))


def jennrich_sampson(x: Array) -> Array:
    i = np.arange(1, 11)
    return np.asarray(2 + 2 * i - (np.exp(i * x[0]) + np.exp(i * x[1])))


def helical_valley(x: Array) -> Array:
    turn = np.arctan(x[1] / x[0]) / (2 * np.pi) + (0.5 if x[0].real < 0 else 0.0)
    return np.array([10 * (x[2] - 10 * turn), 10 * (np.sqrt(x[0] ** 2 + x[1] ** 2) - 1), x[2]])


def bard(x: Array) -> Array:
    y = [0.14, 0.18, 0.22, 0.25, 0.29, 0.32, 0.35, 0.39, 0.37, 0.58, 0.73, 0.96, 1.34, 2.1, 4.39]
    u = np.arange(1, 16)
    v = 16 - u
    return np.asarray(np.array(y) - (x[0] + u / (v * x[1] + np.minimum(u, v) * x[2])))


def box(x: Array) -> Array:
    t = 0.1 * np.arange(1, 11)
    shape = np.exp(-t * x[0]) - np.exp(-t * x[1])
    return np.asarray(shape - x[2] * (np.exp(-t) - np.exp(-10 * t)))


def powell_singular(x: Array) -> Array:
    return np.array(
        [
            x[0] + 10 * x[1],
            math.sqrt(5) * (x[2] - x[3]),
            (x[1] - 2 * x[2]) ** 2,
            math.sqrt(10) * (x[0] - x[3]) ** 2,
        ]
    )


def wood(x: Array) -> Array:
    return np.array(
        [
            10 * (x[1] - x[0] ** 2),
            1 - x[0],
            math.sqrt(90) * (x[3] - x[2] ** 2),
            1 - x[2],
            math.sqrt(10) * (x[1] + x[3] - 2),
            (x[1] - x[3]) / math.sqrt(10),
        ]
    )


def brown_dennis(x: Array) -> Array:
    t = np.arange(1, 21) / 5
    line, wave = x[0] + t * x[1] - np.exp(t), x[2] + x[3] * np.sin(t) - np.cos(t)
    return np.asarray(line**2 + wave**2)


@dataclass(frozen=True)
class Known:
    residual: Function
    start: tuple[float, ...]
    squares: float


KNOWN = [
    Known(rosenbrock, (-1.2, 1), 0),
    Known(freudenstein_roth, (0.5, -2), 48.9842),
    Known(brown_badly_scaled, (1, 1), 0),
    Known(beale, (1, 1), 0),
    Known(jennrich_sampson, (0.3, 0.4), 124.362),
    Known(helical_valley, (-1, 0, 0), 0),
    Known(bard, (1, 1, 1), 8.21487e-3),
    Known(box, (0, 10, 20), 0),
    Known(powell_singular, (3, -1, 0, 1), 0),
    Known(wood, (-3, -1, -3, -1), 0),
    Known(brown_dennis, (25, 5, -5, -1), 85822.2),
]
