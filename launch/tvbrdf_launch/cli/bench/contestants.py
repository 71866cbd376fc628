"""What `tvbrdf bench fit` compares: solvers, and with how many digits their data are given."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from tvbrdf_fitting.geometry import FloatArray
from tvbrdf_fitting.observations import Observations
from tvbrdf_fitting.problem import Problem
from tvbrdf_fitting.solve.solvers import SOLVERS

PRECISIONS = {"float64": np.float64, "float32": np.float32, "float16": np.float16}
"""Of radiances and directions as they are given; all arithmetic is in float64."""
SINGLE_START = "scipy lm"


@dataclass(frozen=True)
class Contestant:
    """A solver and a precision of its data."""

    solver: str
    precision: str = "float64"

    def given(self, observations: Observations) -> Observations:
        """Return observations as this precision carries them."""
        return rounded(observations, self.precision)

    def solve(self, problem: Problem) -> FloatArray:
        """Return internal coordinates (p,); where the solver breaks down, its start."""
        if self.solver == SINGLE_START:
            return single_start(problem)
        return SOLVERS[self.solver](problem).internal


CONTESTANTS = (
    Contestant("separable"),
    Contestant("separable", "float32"),
    Contestant("separable", "float16"),
    Contestant("paper"),
    Contestant("trust_region"),
    Contestant(SINGLE_START),
)


def rounded(observations: Observations, precision: str) -> Observations:
    """Return observations whose radiances and directions were rounded to a precision."""
    kind = PRECISIONS[precision]
    if kind is np.float64:
        return observations
    light, view = (
        array.astype(kind).astype(np.float64)
        for array in (observations.light_direction, observations.view_direction)
    )
    return replace(
        observations,
        radiance=observations.radiance.astype(kind).astype(np.float64),
        light_direction=light / np.linalg.norm(light, axis=1)[:, None],
        view_direction=view / np.linalg.norm(view, axis=1)[:, None],
    )


def generic_start(problem: Problem) -> FloatArray:
    """Return the start (6,) for Oren-Nayar + Torrance-Sparrow that one would write for any scan.

    Albedos are the mean radiance over the mean cosine; all else is a guess.
    """
    used = (problem.weight > 0) * 1.0
    cosine = np.maximum((used * problem.to_radiance).sum(axis=1) / math.pi, 1e-12)
    albedo = np.clip((used * problem.radiance).sum(axis=1) / cosine, 0.01, 1.0)
    return np.array([*albedo, 0.1, 0.5, math.log(5.0)])


def single_start(problem: Problem) -> FloatArray:
    """MINPACK's Levenberg-Marquardt with 2-point derivatives from one start, all defaults."""
    start = generic_start(problem)
    with np.errstate(all="ignore"):  # it knows no bounds, and steps anywhere
        try:
            end = np.asarray(least_squares(problem.residual, start, method="lm").x)
        except ValueError:  # residuals were not finite
            end = start
    return problem.clamp(end)
