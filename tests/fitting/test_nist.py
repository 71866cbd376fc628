"""The general solver certified on NIST's 27 nonlinear regression problems, from both starts.

Certified values have 11 digits, so the log relative error of an exact answer lies above 10.3: ten
digits is what the files can certify. How close an answer is beyond that is measured against our
own in longdouble, where the hardware has one.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.fitting.nist_problems import MODELS, NistProblem, read_nist
from tvbrdf_fitting.solve.levenberg_marquardt import LeastSquaresSolution, levenberg_marquardt

NAMES = sorted(MODELS)
HAS_LONGDOUBLE = np.finfo(np.longdouble).eps < 1e-18

needs_longdouble = pytest.mark.skipif(not HAS_LONGDOUBLE, reason="longdouble is float64 here")


@pytest.fixture(scope="session")
def nist_folder(shared_data: Path) -> Path:
    folder = shared_data / "nist_strd"
    if not folder.is_dir():
        pytest.skip(f"no NIST problems at {folder}")
    return folder


def read(folder: Path, name: str) -> NistProblem:
    return read_nist(folder / f"{name}.dat")


def digits(value: object, certified: object) -> float:
    """Log relative error of the worst number."""
    value, certified = np.asarray(value, np.longdouble), np.asarray(certified, np.longdouble)
    return float(-np.log10(np.max(np.abs(value - certified) / np.abs(certified)) + 1e-30))


def deviations(solution: LeastSquaresSolution) -> np.ndarray:
    m, n = solution.jacobian.shape
    return np.asarray(np.sqrt(2 * solution.cost / (m - n) * np.diag(solution.covariance())))


@pytest.mark.parametrize("start", [0, 1], ids=["harder", "easier"])
@pytest.mark.parametrize("name", NAMES)
def test_certified_values(nist_folder: Path, name: str, start: int) -> None:
    problem = read(nist_folder, name).as_double()
    solution = levenberg_marquardt(problem.residual, problem.jacobian, problem.starts[start])
    assert solution.converged, solution.reason
    assert digits(solution.x, problem.certified) >= 10
    if name != "Lanczos1":
        # residuals of Lanczos1 are 1e-13, of which float64 carries three digits; see below
        # and of Lanczos2 1e-6, of which it carries ten: twice as many get lost in their squares
        assert digits(2 * solution.cost, problem.residual_sum) >= 9
        assert digits(deviations(solution), problem.deviations) >= 9
    # measured: at most 209; a margin for other processors, on which long paths may differ
    assert solution.evaluations <= 500


@needs_longdouble
@pytest.mark.parametrize("start", [0, 1], ids=["harder", "easier"])
def test_longdouble_certifies_tiny_residuals(nist_folder: Path, start: int) -> None:
    problem = read(nist_folder, "Lanczos1")
    solution = levenberg_marquardt(problem.residual, problem.jacobian, problem.starts[start])
    assert solution.x.dtype == np.longdouble
    assert digits(solution.x, problem.certified) >= 10
    # rounding of the data's 13 digits to longdouble, 1e-19, by residuals of 1e-13
    assert digits(2 * solution.cost, problem.residual_sum) >= 6
    assert digits(deviations(solution), problem.deviations) >= 6


@needs_longdouble
@pytest.mark.parametrize("name", NAMES)
def test_digits_beyond_the_certified(nist_folder: Path, name: str) -> None:
    problem = read(nist_folder, name)
    exact = [
        levenberg_marquardt(problem.residual, problem.jacobian, start) for start in problem.starts
    ]
    # the residual's rounding, 1e-19, by the worst sensitivity of a parameter, 1e4 in Lanczos1
    assert digits(exact[0].x, exact[1].x) >= 14
    assert digits(exact[0].x, problem.certified) >= 10
    double = problem.as_double()
    for start in double.starts:
        solution = levenberg_marquardt(double.residual, double.jacobian, start)
        # measured: 11.9 at least (Lanczos2: the data's rounding, 1e-16, by a condition of 1e4)
        assert digits(solution.x, exact[0].x) >= 11.5


@pytest.mark.parametrize("name", NAMES)
def test_path_is_not_a_lucky_one(nist_folder: Path, name: str) -> None:
    problem = read(nist_folder, name).as_double()
    rng = np.random.default_rng(NAMES.index(name))
    for size in (1e-9, 1e-6, 1e-3):
        start = problem.starts[0] * (1 + size * rng.normal(size=problem.certified.size))
        solution = levenberg_marquardt(problem.residual, problem.jacobian, start)
        assert solution.converged, solution.reason
        assert digits(2 * solution.cost, problem.residual_sum) >= (2 if name == "Lanczos1" else 9)


@pytest.mark.parametrize("factor", [1e-6, 1e6])
@pytest.mark.parametrize("name", ["Misra1a", "Thurber", "Gauss3", "Rat43", "ENSO"])
def test_units_of_the_residual_do_not_matter(nist_folder: Path, name: str, factor: float) -> None:
    problem = read(nist_folder, name).as_double()
    plain = levenberg_marquardt(problem.residual, problem.jacobian, problem.starts[0])
    scaled = levenberg_marquardt(
        lambda b: factor * problem.residual(b),
        lambda b: factor * problem.jacobian(b),
        problem.starts[0],
    )
    # the last steps are rounding, and may be one more or fewer
    assert abs(scaled.evaluations - plain.evaluations) <= 3
    assert digits(scaled.x, plain.x) >= 12
    assert digits(scaled.cost, plain.cost * factor**2) >= 12


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_of_the_models(nist_folder: Path, name: str) -> None:
    problem = read(nist_folder, name).as_double()
    step = 1e-150
    for b in (problem.certified, *problem.starts):
        columns = []
        for i in range(b.size):
            shifted = b.astype(complex)
            shifted[i] += 1j * step
            columns.append(problem.model(shifted, problem.x + 0j)[0].imag / step)
        expected = np.stack(columns, axis=1)
        largest = np.abs(expected).max(axis=0)
        # rounding of a few operations; cancellation in the rational and periodic ones
        assert (np.abs(problem.jacobian(b) - expected) <= 1e-12 * largest).all()


@pytest.mark.parametrize("name", NAMES)
def test_models_and_data_as_read(nist_folder: Path, name: str) -> None:
    problem = read(nist_folder, name)
    residual = problem.residual(problem.certified)
    if name == "Lanczos1":
        # parameters of 11 digits cannot show residuals of 1e-13
        assert np.abs(residual).max() < 1e-10
        return
    assert digits(residual @ residual, problem.residual_sum) >= 9
    m, n = residual.size, problem.certified.size
    assert problem.starts.shape == (2, n)
    assert problem.jacobian(problem.certified).shape == (m, n)


def test_broken_file_is_refused(nist_folder: Path, tmp_path: Path) -> None:
    text = (nist_folder / "Misra1a.dat").read_text(encoding="ascii")
    cut = tmp_path / "Misra1a.dat"
    cut.write_text(text[: len(text) - 100], encoding="ascii")
    with pytest.raises(ValueError, match=r"Misra1a\.dat"):
        read_nist(cut)
