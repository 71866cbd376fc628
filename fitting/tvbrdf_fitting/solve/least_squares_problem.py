"""A least squares problem as a search sees it: checked arguments, and points with what is known.

A `Point` holds the residual, its derivatives, and the Gauss-Newton step within the bounds; a
`BoundedProblem` computes points, counts, and says what of a residual may be rounding.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..geometry import FloatArray
from .least_squares_step import LinearModel, Step, length_of

_LEVEL = 1e-6
"""Cosine between residual and columns up to which a point may be a minimum."""


class LeastSquaresError(ValueError):
    """The problem cannot be solved as stated; the message says what is wrong with it."""


@dataclass(eq=False, slots=True)
class Point:
    """A point, its residual (m,) and derivatives (m, n), and what follows from them.

    `box`: bounds of u, the step times the lengths of its columns. `step`: the Gauss-Newton step.
    """

    x: FloatArray
    residual: FloatArray
    jacobian: FloatArray
    model: LinearModel
    box: tuple[FloatArray, FloatArray] | None
    step: Step

    def reduction(self, value: FloatArray) -> float:
        """Return by how much half the sum of squares falls, without a difference of the sums."""
        if value.shape != self.residual.shape:
            raise LeastSquaresError(
                f"residual returned shape {value.shape}, after {self.residual.shape} before"
            )
        return 0.5 * float((self.residual - value) @ (self.residual + value))


class BoundedProblem:
    """Residual, Jacobian, start and bounds, all checked; counts what is computed.

    Attributes
    ----------
    start
        The first x, within the bounds.
    lower, upper
        (n,) bounds, or None where there are none.
    evaluations, jacobians
        How often the residual and its derivatives were computed.
    """

    def __init__(
        self,
        residual: Callable[[Any], Any],
        jacobian: Callable[[Any], Any],
        start: ArrayLike,
        lower: ArrayLike | None,
        upper: ArrayLike | None,
    ) -> None:
        x = np.array(start)
        if x.dtype != np.longdouble:
            x = x.astype(np.float64)
        if x.ndim != 1 or not x.size or not np.isfinite(x).all():
            raise LeastSquaresError(f"start must be finite numbers (n,), not {start!r}")
        self.lower = as_vector("lower", -np.inf if lower is None else lower, x.size)
        self.upper = as_vector("upper", np.inf if upper is None else upper, x.size)
        low, high = self.lower, self.upper
        wrong = np.flatnonzero(~(low <= high) | (low == np.inf) | (high == -np.inf))
        if wrong.size:
            i = int(wrong[0])
            raise LeastSquaresError(
                f"bounds of parameter {i} leave nothing: lower {low[i]}, upper {high[i]}"
            )
        self._bounded = bool(np.isfinite(low).any() or np.isfinite(high).any())
        self.start: FloatArray = np.clip(x, low, high).astype(x.dtype) if self._bounded else x
        self.evaluations = self.jacobians = 0
        self._residual, self._jacobian = residual, jacobian
        self._epsilon = 0.0
        self._work = np.empty((0, 0))

    def first_point(self) -> Point:
        """Return the start.

        Raises
        ------
        LeastSquaresError
            Arrays of the wrong shape, or numbers that are not finite.
        """
        x = self.start
        value = self.evaluate(x)
        if value.ndim != 1 or not value.size:
            raise LeastSquaresError(f"residual must return (m,) numbers, not shape {value.shape}")
        place = np.flatnonzero(~np.isfinite(value))
        if place.size:
            raise LeastSquaresError(
                f"residual {int(place[0])} is {value[place[0]]} at the start "
                f"({place.size} of {value.size} are not finite): start where the model is defined"
            )
        self._epsilon = float(max(np.finfo(x.dtype).eps, np.finfo(value.dtype).eps))
        slopes = self._slopes(x)
        if slopes.shape != (value.size, x.size):
            raise LeastSquaresError(
                f"jacobian must return shape {(value.size, x.size)}, not {slopes.shape}"
            )
        columns = np.flatnonzero(~np.isfinite(slopes).all(axis=0))
        if columns.size:
            raise LeastSquaresError(
                f"the derivative by parameter {int(columns[0])} is not finite at the start: "
                "start where it is defined"
            )
        self._work = np.zeros((max(value.size, x.size + 1), x.size + 1), order="F")
        point = self._linearise(x, value, slopes)
        if point is None:
            raise LeastSquaresError(
                "the residual or its derivatives at the start are too large to square: rescale them"
            )
        return point

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Return the residual (m,), in longdouble only if it was computed so."""
        self.evaluations += 1
        return _floats(self._residual(x))

    def point(self, x: FloatArray, value: FloatArray) -> Point | None:
        """Return the point whose residual is known, None where a derivative is not finite."""
        return self._linearise(x, value, self._slopes(x))

    def _slopes(self, x: FloatArray) -> FloatArray:
        self.jacobians += 1
        return _floats(self._jacobian(x))

    def _linearise(self, x: FloatArray, value: FloatArray, slopes: FloatArray) -> Point | None:
        model = LinearModel(value, slopes, self._work)
        if not model.is_finite:
            return None
        if slopes.dtype == np.longdouble:
            model.refine(((slopes.T @ value) / model.unit).astype(np.float64))
            slopes = slopes.astype(np.float64)
        box = None
        if self._bounded:
            box = (
                ((self.lower - x) * model.unit).astype(np.float64),
                ((self.upper - x) * model.unit).astype(np.float64),
            )
        return Point(x, value, slopes, model, box, model.gauss_newton(box))

    def move(self, point: Point, u: FloatArray) -> FloatArray:
        """Return x after a step, exactly at the bounds that it reaches."""
        x: FloatArray = point.x + u / point.model.unit
        if point.box is None:
            return x
        lowest, highest = point.box
        x = np.where(u <= lowest, self.lower, np.where(u >= highest, self.upper, x))
        return np.clip(x, self.lower, self.upper).astype(point.x.dtype)

    def rounding(self, point: Point) -> float:
        """Return how far the residual is off by rounding at most, commonly, as a length.

        Its own last digit, and what a change in the last digit of each parameter does to it.
        """
        own = float(np.abs(point.x) @ point.model.size)
        return self._epsilon * (point.model.norm + own)

    def is_rounding(self, point: Point, step: Step) -> bool:
        """Whether a step is at most what rounding commonly makes of it.

        Rounding of the residuals points anywhere, so that little of it lies in the tangent plane;
        rounding of x is a step. A number is off by 0.3 of its last digit in the mean square.
        """
        share = math.sqrt(point.x.size / point.residual.size)
        own = length_of(point.x.astype(np.float64) * point.model.size)
        return step.promise <= 0.3 * self._epsilon * point.model.norm * share or (
            length_of(step.u) <= self._epsilon * own
        )

    def is_level(self, point: Point) -> bool:
        """Whether no column that may move has a slope left but rounding, which short steps hide."""
        slope = np.abs(point.model.gradient())
        slope[list(self.held(point))] = 0.0
        return bool(slope.max() <= max(_LEVEL * point.model.norm, 10 * self.rounding(point)))

    def held(self, point: Point) -> tuple[int, ...]:
        """Return the parameters at a bound that the cost would cross if it could."""
        slope = point.model.gradient()
        held = ((point.x <= self.lower) & (slope >= 0)) | ((point.x >= self.upper) & (slope <= 0))
        return tuple(int(i) for i in np.flatnonzero(held | (self.lower == self.upper)))


def _floats(values: Any) -> FloatArray:
    array: FloatArray = np.asarray(values)
    return array if array.dtype == np.longdouble else array.astype(np.float64, copy=False)


def as_vector(name: str, value: ArrayLike, n: int) -> FloatArray:
    """Return a number or n of them as (n,), or raise an error that names it."""
    array = np.asarray(value, dtype=np.float64)
    if array.shape not in {(), (n,)}:
        raise LeastSquaresError(f"{name} must be a number or {n} of them, not shape {array.shape}")
    return np.broadcast_to(array, (n,))
