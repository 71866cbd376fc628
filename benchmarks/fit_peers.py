"""Other people's solvers on our problem, each in several settings; see `fit_speed`.

All get the prepared geometry, our coordinates, the residuals of `fit_residuals`, and derivatives
where they can take them. What depends on the scan alone is built before the clock starts.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from benchmarks.fit_residuals import PARAMETERS, Residuals, write_residual, write_rows
from tvbrdf_fitting.geometry import FloatArray

Run = Callable[[FloatArray], FloatArray]
"""From a start (6,) to an answer (6,)."""
NAMES = ("kd_b", "kd_g", "kd_r", "sigma_d_squared", "ks", "log_inverse_sigma_s")
INSTALL = "pip install 'tvbrdf[bench]'"
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)
CAREFUL = 1e-10


@dataclass(frozen=True)
class Contender:
    """A peer in one setting, for one scan.

    Attributes
    ----------
    peer
        Name and version.
    setting
        In words.
    run
        What is timed.
    careful
        The setting that is tried from many starts: bounds where the peer has them, no shortcuts.
    """

    peer: str
    setting: str
    run: Run
    careful: bool = False


def reference(residuals: Residuals) -> Contender:
    """scipy's MINPACK with 2-point derivatives, as people fit: all defaults."""

    def run(start: FloatArray) -> FloatArray:
        return np.asarray(least_squares(residuals.residual, start, method="lm").x)

    return Contender(
        f"scipy {version('scipy')} lm, 2-point", "numpy, 2-point derivatives, defaults", run
    )


def contenders(residuals: Residuals) -> Iterator[Contender]:
    """All settings of all peers that are installed."""
    for module, build in BUILDERS.items():
        if module not in missing():
            yield from build(residuals)


def missing() -> dict[str, str]:
    """Return the peers that are not installed, with the reason."""
    absent = {}
    for module in BUILDERS:
        try:
            importlib.import_module(module)
        except ImportError as error:
            absent[module] = f"{module} is skipped ({error}); install it with: {INSTALL}"
    return absent


def _kinds(residuals: Residuals) -> dict[str, tuple[Run, Run, Run]]:
    """Residual, Jacobian (3 n, 6) and its transpose, by how they are written."""
    r = residuals
    return {
        "numpy": (r.residual, r.jacobian, r.columns),
        "compiled": (r.compiled_residual, r.compiled_jacobian, r.compiled_columns),
    }


def scipy_contenders(residuals: Residuals) -> Iterator[Contender]:
    """MINPACK and the trust region, with analytic derivatives."""
    peer = f"scipy {version('scipy')}"
    bounds = (residuals.lower, residuals.upper)
    for kind, (residual, jacobian, _) in _kinds(residuals).items():
        options: list[tuple[str, dict[str, Any]]] = [
            (f"{peer} lm", {"method": "lm"}),
            (f"{peer} trf", {"method": "trf"}),
            (f"{peer} trf", {"method": "trf", "x_scale": "jac"}),
            (f"{peer} trf", {"method": "trf", "x_scale": "jac", "bounds": bounds}),
            (f"{peer} trf", {"method": "trf", "bounds": bounds}),
        ]
        for name, chosen in options:
            for tolerance in TOLERANCES:
                yield _scipy_contender(name, kind, residual, jacobian, chosen, tolerance)


def _scipy_contender(
    name: str, kind: str, residual: Run, jacobian: Run, options: dict[str, Any], tolerance: float
) -> Contender:
    limits = dict.fromkeys(("ftol", "xtol", "gtol"), tolerance)

    def run(start: FloatArray) -> FloatArray:
        return np.asarray(least_squares(residual, start, jac=jacobian, **options, **limits).x)

    words = [kind, "analytic derivatives", f"tolerances {tolerance:.0e}"]
    words += ["x_scale jac"] if "x_scale" in options else []
    words += ["bounds"] if "bounds" in options else []
    careful = (
        kind == "compiled" and tolerance == CAREFUL and (name.endswith("lm") or len(words) == 5)
    )
    return Contender(name, ", ".join(words), run, careful)


def lmfit_contenders(residuals: Residuals) -> Iterator[Contender]:
    """lmfit's leastsq, with derivatives, without and with its bounds."""
    lmfit: Any = importlib.import_module("lmfit")
    for kind, (residual, _, columns) in _kinds(residuals).items():
        for bounded in (False, True):
            for tolerance in TOLERANCES:
                yield _lmfit_contender(
                    lmfit, kind, residual, columns, residuals, bounded, tolerance
                )


def _lmfit_contender(
    lmfit: Any,
    kind: str,
    residual: Run,
    columns: Run,
    residuals: Residuals,
    bounded: bool,
    tolerance: float,
) -> Contender:
    def vector(parameters: Any) -> FloatArray:
        return np.array([parameters[name].value for name in NAMES])

    def run(start: FloatArray) -> FloatArray:
        parameters = lmfit.Parameters()
        for name, value, low, high in zip(
            NAMES, start, residuals.lower, residuals.upper, strict=True
        ):
            limits = {"min": low, "max": high} if bounded else {}
            parameters.add(name, value=float(value), **limits)
        minimizer = lmfit.Minimizer(
            lambda p: residual(vector(p)), parameters, calc_covar=False, scale_covar=False
        )
        found = minimizer.leastsq(
            Dfun=lambda p: columns(vector(p)), col_deriv=1, ftol=tolerance, xtol=tolerance
        )
        return vector(found.params)

    words = f"leastsq, {kind}, Dfun, tolerances {tolerance:.0e}{', bounds' if bounded else ''}"
    careful = kind == "compiled" and bounded and tolerance == CAREFUL
    return Contender(f"lmfit {version('lmfit')}", words, run, careful)


def pyceres_contenders(residuals: Residuals) -> Iterator[Contender]:
    """Ceres through pyceres, its cost function in Python with analytic derivatives."""
    pyceres: Any = importlib.import_module("pyceres")
    for kind in ("numpy", "compiled"):
        for solver in ("DENSE_QR", "DENSE_NORMAL_CHOLESKY"):
            for strategy in ("LEVENBERG_MARQUARDT", "DOGLEG"):
                for tolerance in TOLERANCES:
                    yield _pyceres_contender(
                        pyceres, residuals, kind, solver, strategy, tolerance, bounded=False
                    )
        yield _pyceres_contender(
            pyceres,
            residuals,
            kind,
            "DENSE_NORMAL_CHOLESKY",
            "LEVENBERG_MARQUARDT",
            CAREFUL,
            bounded=True,
        )


def _pyceres_contender(
    pyceres: Any,
    residuals: Residuals,
    kind: str,
    solver: str,
    strategy: str,
    tolerance: float,
    *,
    bounded: bool,
) -> Contender:
    shape = residuals.problem.radiance.shape
    columns = np.empty((PARAMETERS, *shape))

    class Cost(pyceres.CostFunction):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__()
            self.set_num_residuals(math.prod(shape))
            self.set_parameter_block_sizes([PARAMETERS])

        def Evaluate(self, parameters: Any, out: Any, jacobians: Any) -> bool:  # noqa: N802
            x = parameters[0]
            if kind == "numpy":
                out[:] = residuals.residual(x)
                if jacobians is not None:
                    jacobians[0].reshape(-1, PARAMETERS)[:] = residuals.columns(x).T
                return True
            write_residual(x, *residuals.data, out.reshape(shape))
            if jacobians is not None:
                write_rows(x, *residuals.data, jacobians[0].reshape(-1, PARAMETERS), columns)
            return True

    cost, x = Cost(), np.array(residuals.start)
    problem = pyceres.Problem()
    problem.add_residual_block(cost, None, [x])
    if bounded:
        for k in range(PARAMETERS):
            problem.set_parameter_lower_bound(x, k, float(residuals.lower[k]))
            if math.isfinite(residuals.upper[k]):
                problem.set_parameter_upper_bound(x, k, float(residuals.upper[k]))
    options = pyceres.SolverOptions()
    options.linear_solver_type = getattr(pyceres.LinearSolverType, solver)
    options.trust_region_strategy_type = getattr(pyceres.TrustRegionStrategyType, strategy)
    options.function_tolerance = options.parameter_tolerance = tolerance
    options.gradient_tolerance = 1e-14
    options.max_num_iterations = 200
    options.logging_type = pyceres.LoggingType.SILENT
    summary = pyceres.SolverSummary()

    def run(start: FloatArray) -> FloatArray:
        x[:] = start
        pyceres.solve(options, problem, summary)
        return x.copy()

    words = [kind, solver, strategy, f"tolerances {tolerance:.0e}"]
    words += ["bounds"] if bounded else []
    careful = kind == "compiled" and bounded
    contender = Contender(f"pyceres {version('pyceres')}", ", ".join(words), run, careful)
    run.keep = (cost, problem)  # type: ignore[attr-defined]  # Ceres does not own the cost
    return contender


def optimistix_contenders(residuals: Residuals) -> Iterator[Contender]:
    """optimistix, jitted in float64, derivatives by jax; compiled before the clock starts."""
    jax: Any = importlib.import_module("jax")
    jax.config.update("jax_enable_x64", True)
    jnp: Any = importlib.import_module("jax.numpy")
    peer = f"optimistix {version('optimistix')} (jax {version('jax')})"
    data = tuple(jnp.asarray(a) for a in residuals.data)
    for method in ("LevenbergMarquardt", "Dogleg"):
        for linear in ("normal equations", "QR"):
            for tolerance in TOLERANCES:
                words = f"{method}, {linear}, tolerances {tolerance:.0e}"
                solve = _optimistix_solve(method, linear, tolerance)
                careful = (method, linear) == ("LevenbergMarquardt", "QR") and tolerance == CAREFUL
                yield Contender(peer, words, _optimistix_run(jax, solve, data), careful)


@cache
def _optimistix_solve(method: str, linear: str, tolerance: float) -> Any:
    """Return the jitted solver; jax compiles it again only for another number of values."""
    jax, lineax, optimistix = map(importlib.import_module, ("jax", "lineax", "optimistix"))
    linear_solver = lineax.QR() if linear == "QR" else lineax.Normal(lineax.Cholesky())
    solver = getattr(optimistix, method)(
        rtol=tolerance, atol=tolerance, linear_solver=linear_solver
    )

    def solve(x: Any, data: Any) -> Any:
        return optimistix.least_squares(
            jax_residual, solver, x, args=data, max_steps=256, throw=False
        ).value

    return jax.jit(solve)


def _optimistix_run(jax: Any, solve: Any, data: tuple[Any, ...]) -> Run:
    def run(start: FloatArray) -> FloatArray:
        return np.asarray(jax.block_until_ready(solve(start, data)))

    return run


def jax_residual(x: Any, data: tuple[Any, ...]) -> Any:
    """Residuals (3, n) in jax."""
    jnp: Any = importlib.import_module("jax.numpy")
    vectors, f, q, radiance, weight = data
    s = x[3]
    positive = jnp.maximum(s, 0.0)  # tangents below 0, as in `fit_residuals`
    c1, b = 1 - 0.5 * s / (positive + 0.33), s / (positive + 0.09)
    e = 0.17 * s / (positive + 0.13)
    kd = x[:3, None]
    lobe = x[4] * f * jnp.exp(-q * jnp.exp(2 * x[5]))
    value = kd * (c1 * vectors[0] + b * vectors[1]) + kd * kd * e * vectors[2] + lobe
    return (value - radiance) * weight


BUILDERS: dict[str, Callable[[Residuals], Iterator[Contender]]] = {
    "scipy": scipy_contenders,
    "lmfit": lmfit_contenders,
    "pyceres": pyceres_contenders,
    "optimistix": optimistix_contenders,
}
