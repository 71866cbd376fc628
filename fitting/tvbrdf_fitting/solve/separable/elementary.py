"""Compiled arithmetic: a vectorising exponential and the bounded step."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

# sums may be taken in any order, so that they vectorise; no other liberty is taken
SUMS = {"contract", "reassoc", "nsz"}
JIT: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}
"""Compiled once and kept on disk; other threads run meanwhile; 1 / 0 is inf."""

_LOG2_E = 1 / math.log(2)
_LN2_HIGH, _LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
_LARGEST = 708.0  # exp(-709) is no normal number


@intrinsic
def _from_bits(_context: Any, _bits: Any) -> Any:
    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.DoubleType())

    return types.float64(types.int64), generate


@njit(fastmath={"contract"}, **JIT)
def exp_negative(x):
    """Exp(-x) for x >= 0, within 1.5 units in the last place, as a polynomial that vectorises."""
    x = min(x, _LARGEST)
    k = np.floor(x * _LOG2_E + 0.5)
    r = (k * _LN2_HIGH - x) + k * _LN2_LOW
    p = 1 / 6227020800.0
    p = p * r + 1 / 479001600.0
    p = p * r + 1 / 39916800.0
    p = p * r + 1 / 3628800.0
    p = p * r + 1 / 362880.0
    p = p * r + 1 / 40320.0
    p = p * r + 1 / 5040.0
    p = p * r + 1 / 720.0
    p = p * r + 1 / 120.0
    p = p * r + 1 / 24.0
    p = p * r + 1 / 6.0
    p = p * r + 0.5
    p = p * r + 1.0
    p = p * r + 1.0
    bits = (np.int64(1023) - np.int64(k)) << np.int64(52)
    return p * _from_bits(bits)  # type: ignore[call-arg] # the compiler gives the context


@njit(**JIT)
def clip(value, lower, upper):
    """Return the value moved into [lower, upper]."""
    return min(max(value, lower), upper)


@njit(**JIT)
def squared(values):
    """Return the squares of (3, n) values."""
    out = np.empty(values.shape)
    for c in range(3):
        for i in range(values.shape[1]):
            out[c, i] = values[c, i] * values[c, i]
    return out


@njit(**JIT)
def write_scale(x, matrix, gradient, lower, upper, scale, free):
    """Write each coordinate's scale, and whether a step may change it."""
    for i in range(x.shape[0]):
        scale[i] = math.sqrt(matrix[i, i]) if matrix[i, i] > 0 else 1.0
        outward = (x[i] <= lower[i] and gradient[i] >= 0) or (x[i] >= upper[i] and gradient[i] <= 0)
        free[i] = matrix[i, i] > 0 and not outward and lower[i] < upper[i]


@njit(**JIT)
def solve_damped(matrix, gradient, scale, free, damping, factor, step):
    """Solve (D H D + damping) D^-1 step = -D gradient, D = 1 / scale, for the free coordinates.

    By Cholesky's factor, written into `factor`. Return False where the matrix is not positive.
    """
    size = gradient.shape[0]
    for i in range(size):
        if not free[i]:
            continue
        for j in range(i + 1):
            if not free[j]:
                continue
            total = matrix[i, j] / (scale[i] * scale[j])
            for k in range(j):
                if free[k]:
                    total -= factor[i, k] * factor[j, k]
            if i > j:
                factor[i, j] = total / factor[j, j]
                continue
            total += damping
            if not total > 1e-15:
                return False
            factor[i, i] = math.sqrt(total)
    for i in range(size):
        step[i] = 0.0
        if free[i]:
            total = -gradient[i] / scale[i]
            for k in range(i):
                if free[k]:
                    total -= factor[i, k] * step[k]
            step[i] = total / factor[i, i]
    for i in range(size - 1, -1, -1):
        if free[i]:
            total = step[i]
            for k in range(i + 1, size):
                if free[k]:
                    total -= factor[k, i] * step[k]
            step[i] = total / factor[i, i]
    for i in range(size):
        step[i] /= scale[i]
    return True


@njit(**JIT)
def bounded_step(matrix, gradient, scale, x, lower, upper, damping, free, factor, work, step):
    """Write the damped step within the bounds; False if it can't be solved.

    A coordinate whose step would leave the bounds goes as far as its bound, and the others answer
    to that. `work` (2, size) is overwritten, as is `free`.
    """
    size = x.shape[0]
    pull, fixed = work[0], work[1]
    pull[:] = gradient
    fixed[:] = 0.0
    for _ in range(size + 1):
        if not solve_damped(matrix, pull, scale, free, damping, factor, step):
            return False
        blocked = False
        for i in range(size):
            if free[i] and not lower[i] <= x[i] + step[i] <= upper[i]:
                free[i] = False
                blocked = True
                fixed[i] = (lower[i] if x[i] + step[i] < lower[i] else upper[i]) - x[i]
                for j in range(size):
                    pull[j] += matrix[j, i] * fixed[i]
        if not blocked:
            break
    for i in range(size):
        if not free[i]:
            step[i] = fixed[i]
    return True
