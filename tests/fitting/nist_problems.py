"""NIST's 27 nonlinear regression problems: models with derivatives, and a reader of their files.

Source: NIST/ITL Statistical Reference Datasets (StRD), nonlinear least squares regression. Each
file holds the data, two starts (the first is the harder one), and certified parameters, standard
deviations and residual sum of squares to 11 digits.

A model takes parameters b (n,) and predictors x, and returns its value and its derivatives, one
array a parameter. It computes in the arithmetic of what it is given: float64, longdouble, or
complex (for derivatives by complex step).
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Model = Callable[[Array, Array], tuple[Array, list[Array]]]


def _bennett5(b: Array, x: Array) -> tuple[Array, list[Array]]:
    base, power = b[1] + x, -1 / b[2]
    shape = base**power
    slope = b[0] * shape
    return slope, [shape, slope * power / base, slope * np.log(base) / b[2] ** 2]


def _saturating(b: Array, x: Array) -> tuple[Array, list[Array]]:
    """Return b1 (1 - exp(-b2 x)): BoxBOD and Misra1a."""
    rise = -np.expm1(-b[1] * x)
    return b[0] * rise, [rise, b[0] * x * np.exp(-b[1] * x)]


def _chwirut(b: Array, x: Array) -> tuple[Array, list[Array]]:
    below = b[1] + b[2] * x
    y = np.exp(-b[0] * x) / below
    return y, [-x * y, -y / below, -x * y / below]


def _danwood(b: Array, x: Array) -> tuple[Array, list[Array]]:
    power = x ** b[1]
    return b[0] * power, [power, b[0] * power * np.log(x)]


def _enso(b: Array, x: Array) -> tuple[Array, list[Array]]:
    turn = 8 * np.arctan(np.ones((), x.dtype))  # 2 pi in the arithmetic of x
    year = turn * x / 12
    y = b[0] + b[1] * np.cos(year) + b[2] * np.sin(year)
    columns = [np.ones_like(y), np.cos(year), np.sin(year)]
    for period, c, s in (b[3:6], b[6:9]):
        phase = turn * x / period
        cosine, sine = np.cos(phase), np.sin(phase)
        y = y + c * cosine + s * sine
        columns += [(c * sine - s * cosine) * phase / period, cosine, sine]
    return y, columns


def _eckerle4(b: Array, x: Array) -> tuple[Array, list[Array]]:
    z = (x - b[2]) / b[1]
    shape = np.exp(-0.5 * z**2) / b[1]
    y = b[0] * shape
    return y, [shape, y * (z**2 - 1) / b[1], y * z / b[1]]


def _gauss(b: Array, x: Array) -> tuple[Array, list[Array]]:
    decay = np.exp(-b[1] * x)
    y, columns = b[0] * decay, [decay, -b[0] * x * decay]
    for height, centre, width in (b[2:5], b[5:8]):
        z = (x - centre) / width
        bell = np.exp(-(z**2))
        y = y + height * bell
        columns += [bell, 2 * height * bell * z / width, 2 * height * bell * z**2 / width]
    return y, columns


def _ratio(above: int) -> Model:
    """Return a ratio of polynomials, `above` coefficients above, 1 + b x + ... below."""

    def model(b: Array, x: Array) -> tuple[Array, list[Array]]:
        powers = [x**k for k in range(above)]
        over = sum((c * p for c, p in zip(b[:above], powers, strict=True)), np.zeros_like(x))
        under = 1 + sum((c * p for c, p in zip(b[above:], powers[1:], strict=True)), 0 * x)
        y = over / under
        return y, [p / under for p in powers] + [-y * p / under for p in powers[1:]]

    return model


def _exponentials(b: Array, x: Array) -> tuple[Array, list[Array]]:
    """Return a sum of three exponentials: Lanczos 1 to 3."""
    y, columns = np.zeros_like(x), []
    for height, rate in b.reshape(-1, 2):
        decay = np.exp(-rate * x)
        y = y + height * decay
        columns += [decay, -height * x * decay]
    return y, columns


def _mgh09(b: Array, x: Array) -> tuple[Array, list[Array]]:
    over, under = x**2 + x * b[1], x**2 + x * b[2] + b[3]
    y = b[0] * over / under
    return y, [over / under, b[0] * x / under, -y * x / under, -y / under]


def _mgh10(b: Array, x: Array) -> tuple[Array, list[Array]]:
    inverse = 1 / (x + b[2])
    growth = np.exp(b[1] * inverse)
    y = b[0] * growth
    return y, [growth, y * inverse, -y * b[1] * inverse**2]


def _mgh17(b: Array, x: Array) -> tuple[Array, list[Array]]:
    first, second = np.exp(-x * b[3]), np.exp(-x * b[4])
    y = b[0] + b[1] * first + b[2] * second
    return y, [np.ones_like(y), first, second, -b[1] * x * first, -b[2] * x * second]


def _misra1b(b: Array, x: Array) -> tuple[Array, list[Array]]:
    base = 1 + b[1] * x / 2
    return b[0] * (1 - base**-2), [1 - base**-2, b[0] * x * base**-3]


def _misra1c(b: Array, x: Array) -> tuple[Array, list[Array]]:
    root = np.sqrt(1 + 2 * b[1] * x)
    return b[0] * (1 - 1 / root), [1 - 1 / root, b[0] * x / root**3]


def _misra1d(b: Array, x: Array) -> tuple[Array, list[Array]]:
    under = 1 + b[1] * x
    return b[0] * b[1] * x / under, [b[1] * x / under, b[0] * x / under**2]


def _nelson(b: Array, x: Array) -> tuple[Array, list[Array]]:
    time, temperature = x
    share = time * np.exp(-b[2] * temperature)
    y = b[0] - b[1] * share
    return y, [np.ones_like(y), -share, b[1] * temperature * share]


def _rat42(b: Array, x: Array) -> tuple[Array, list[Array]]:
    growth = np.exp(b[1] - b[2] * x)
    under = 1 + growth
    y = b[0] / under
    return y, [1 / under, -y * growth / under, y * x * growth / under]


def _rat43(b: Array, x: Array) -> tuple[Array, list[Array]]:
    growth = np.exp(b[1] - b[2] * x)
    under = 1 + growth
    shape = under ** (-1 / b[3])
    y = b[0] * shape
    slope = y * growth / (under * b[3])
    return y, [shape, -slope, slope * x, y * np.log(under) / b[3] ** 2]


def _roszman1(b: Array, x: Array) -> tuple[Array, list[Array]]:
    pi = 4 * np.arctan(np.ones((), x.dtype))
    away = x - b[3]
    square = away**2 + b[2] ** 2
    y = b[0] - b[1] * x - np.arctan(b[2] / away) / pi
    return y, [np.ones_like(y), -x + 0 * y, -away / square / pi, -b[2] / square / pi]


MODELS: dict[str, Model] = {
    "Bennett5": _bennett5,
    "BoxBOD": _saturating,
    "Chwirut1": _chwirut,
    "Chwirut2": _chwirut,
    "DanWood": _danwood,
    "ENSO": _enso,
    "Eckerle4": _eckerle4,
    "Gauss1": _gauss,
    "Gauss2": _gauss,
    "Gauss3": _gauss,
    "Hahn1": _ratio(4),
    "Kirby2": _ratio(3),
    "Lanczos1": _exponentials,
    "Lanczos2": _exponentials,
    "Lanczos3": _exponentials,
    "MGH09": _mgh09,
    "MGH10": _mgh10,
    "MGH17": _mgh17,
    "Misra1a": _saturating,
    "Misra1b": _misra1b,
    "Misra1c": _misra1c,
    "Misra1d": _misra1d,
    "Nelson": _nelson,
    "Rat42": _rat42,
    "Rat43": _rat43,
    "Roszman1": _roszman1,
    "Thurber": _ratio(4),
}
"""Every problem's model by its name."""


@dataclass(frozen=True, eq=False)
class NistProblem:
    """One problem, its data in the arithmetic it was read with.

    Attributes
    ----------
    starts
        (2, n) starting values, the harder first.
    certified, deviations
        (n,) certified parameters and their standard deviations.
    residual_sum
        Certified sum of squares.
    """

    name: str
    model: Model
    x: Array
    y: Array
    starts: Array
    certified: Array
    deviations: Array
    residual_sum: float

    def residual(self, b: Array) -> Array:
        """Model less data (m,)."""
        return self.model(b, self.x)[0] - self.y

    def jacobian(self, b: Array) -> Array:
        """Return derivatives (m, n) of the residual."""
        return np.stack(self.model(b, self.x)[1], axis=1)

    def as_double(self) -> NistProblem:
        """Return the problem with everything rounded to float64."""
        names = ("x", "y", "starts", "certified", "deviations")
        return replace(self, **{n: getattr(self, n).astype(float) for n in names})


def read_nist(path: Path) -> NistProblem:
    """Read one of NIST's files, its numbers to the last digit of a longdouble."""
    text = path.read_text(encoding="ascii")
    header, table = re.split(r"^Data:\s+y\s.*$", text, maxsplit=1, flags=re.MULTILINE)
    rows = _numbers(re.findall(r"^\s*b\d+\s*=((?:\s+[-+.\dE]+){4})\s*$", header, re.MULTILINE))
    total = re.search(r"Residual Sum of Squares:\s+(\S+)", header)
    count = re.search(r"Number of Observations:\s+(\d+)", header)
    data = _numbers(table.strip().splitlines()).T
    if not total or not count or data.shape[1] != int(count[1]):
        raise ValueError(f"{path}: not one of NIST's nonlinear problems, or cut off")
    y, x = data[0], data[1] if len(data) == 2 else data[1:]
    if path.stem == "Nelson":
        y = np.log(y)
    return NistProblem(
        name=path.stem,
        model=MODELS[path.stem],
        x=x,
        y=y,
        starts=rows[:, :2].T,
        certified=rows[:, 2],
        deviations=rows[:, 3],
        residual_sum=float(total[1]),
    )


def _numbers(lines: list[str]) -> Array:
    return np.array([[np.longdouble(word) for word in line.split()] for line in lines])
