"""Amplitudes of lobes that nobody saw are called undetermined; of well measured ones, never."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.fitting.scans import GLOSSY, LAMBERT, METAL, ROUGH, SATIN, Simulate, sound
from tvbrdf_fitting import CommonErrors, FitResult, Observations, fit_scan, get_model
from tvbrdf_fitting.inference.determined import OUT_OF_SIGHT, unseen
from tvbrdf_fitting.inference.nuisances import make_nuisances
from tvbrdf_fitting.inference.posterior import Posterior, linearise_at
from tvbrdf_fitting.inference.uncertainty import estimate
from tvbrdf_fitting.problem import make_problem

NEEDLE = [0.3, 0.5, 0.7, 0.4, 0.5, 80.0]
"""Half as wide as from one light to the next."""
MATTE = [0.3, 0.5, 0.7, 0.4, 0.0, 6.0]
WELL_KNOWN = 0.2
MODEL = get_model("ON+TS")


def outer_cameras(simulate: Simulate, truth: list[float], seed: int) -> Observations:
    """A scan by cameras 3 and 4, which see no half angle below 25 degrees, at 30 lights."""
    scan = simulate(truth, noise=0.005, seed=seed, step=12)
    return scan.select(scan.camera >= 3)


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def unseen_names(result: FitResult) -> set[str]:
    assert result.optimum is not None
    deviation = np.sqrt(np.diag(result.internal_covariance))
    problem = result.optimum.posterior.problem
    found = unseen(problem, np.array(result.internal_values), deviation)
    return {result.parameter_names[index] for index in found}


class TestUnseen:
    @pytest.mark.parametrize("truth", [NEEDLE, MATTE, SATIN], ids=["needle", "matte", "satin"])
    @pytest.mark.parametrize("errors", [None, CommonErrors(0.02, 0.005)], ids=["plain", "common"])
    def test_a_lobe_lifted_into_the_noise(
        self, simulate: Simulate, truth: list[float], errors: CommonErrors | None
    ) -> None:
        """A hundred times the brightest value and more, with no camera near the peak."""
        lifted = 0
        for seed in range(20):
            scan = outer_cameras(simulate, truth, seed)
            result = sound(fit_scan(scan, common_errors=errors))
            # Kd, known to better than a fifth without the lobe, is none the worse for it
            assert not {"kd_b", "kd_g", "kd_r"} & set(result.undetermined)
            if result.value("ks") > 100 * np.abs(scan.radiance).max():
                lifted += 1
                assert {"ks", "inverse_sigma_s"} <= set(result.undetermined), seed
        assert lifted >= 5

    @pytest.mark.parametrize("scale", [1e-6, 1e6])
    def test_the_scale_of_the_data_does_not_matter(self, simulate: Simulate, scale: float) -> None:
        """Of a model that is linear in its amplitudes, as Oren-Nayar is not quite."""
        model = "lambert+torrance_sparrow"
        lost = []
        for truth in ([0.3, 0.5, 0.7, 0.0, 6.0], [0.3, 0.5, 0.7, 8.0, 2.5]):
            for seed in range(4):
                scan = simulate(truth, model, noise=0.005, seed=seed, step=12)
                scan = scan.select(scan.camera >= 3)
                scaled = replace(
                    scan, radiance=scan.radiance * scale, variance=scan.variance * scale**2
                )
                lost.append(unseen_names(fit_scan(scan, model)))
                assert unseen_names(fit_scan(scaled, model)) == lost[-1]
        assert {"ks"} in lost[:4]
        assert lost[4:] == [set()] * 4

    def test_a_significant_amplitude_out_of_sight(self, simulate: Simulate) -> None:
        """However small its deviation: the flank of a wrong model's lobe fits very well."""
        scan = simulate(SATIN, noise=0.005, step=12)
        problem = make_problem(scan, MODEL, {}, {})
        internal = MODEL.to_internal(SATIN)
        brightest = float(np.abs(problem.radiance[problem.weight > 0]).max())
        # along the normal the lobe is a quarter of its amplitude
        limit = OUT_OF_SIGHT * brightest / (np.pi / 4)
        internal[4] = 1.01 * limit
        assert unseen(problem, internal, 1e-3 * internal) == (4,)
        internal[4] = 0.99 * limit
        assert unseen(problem, internal, 1e-3 * internal) == ()

    def test_its_width_is_lost_with_it(self, simulate: Simulate) -> None:
        """A flank of 1e-9 of the peak, in every value: significant, and yet no answer."""
        truth = [0.3, 0.5, 0.7, 0.4, 1e9, 20.5]
        scan = simulate(truth, noise=0.001, step=6)
        far = scan.select((scan.camera == 2) & (np.abs(scan.radiance).max(axis=1) < 3.0))
        result = fit_scan(far, fixed={"kd_b": 0.3, "kd_g": 0.5, "kd_r": 0.7, "sigma_d": 0.4})
        assert result.value("ks") > 10 * result.standard_deviation("ks")
        assert {"ks", "inverse_sigma_s"} <= set(result.undetermined)

    def test_each_colour_of_its_own(self, simulate: Simulate) -> None:
        """A metal's blue is dead but for the outer cameras: its amplitude alone is unseen."""
        scan = simulate([*METAL[:7], 60.0], "oren_nayar+torrance_sparrow(coloured)", noise=0.005,
                        step=12)  # fmt: skip
        blind = scan.valid.copy()
        blind[scan.camera == 1, 0] = False
        result = fit_scan(replace(scan, valid=blind), "oren_nayar+torrance_sparrow(coloured)")
        assert {"ks_b", "ks_g", "ks_r"} & set(result.undetermined) == {"ks_b"}
        assert "inverse_sigma_s" not in result.undetermined


class TestSeen:
    @pytest.mark.parametrize("truth", [MATTE, [*LAMBERT[:4], 0.0, 6.0]], ids=["rough", "lambert"])
    @pytest.mark.parametrize("seed", range(5))
    def test_next_to_nothing_is_an_answer(
        self, simulate: Simulate, truth: list[float], seed: int
    ) -> None:
        """No lobe, all cameras: Ks is 0 within its noise, and determined; its width is not."""
        result = fit_scan(simulate(truth, noise=0.005, seed=seed, step=6))
        assert "ks" not in result.undetermined
        assert "inverse_sigma_s" in result.undetermined

    def test_darkness_is_an_answer(self, simulate: Simulate) -> None:
        scan = simulate(SATIN, noise=0.005, step=12)
        result = fit_scan(replace(scan, radiance=np.zeros(scan.radiance.shape)))
        assert not {"kd_b", "kd_g", "kd_r", "ks"} & set(result.undetermined)

    def test_a_flank_that_tells_the_peak_is_enough(self, simulate: Simulate) -> None:
        """The peak in camera 1 is hidden: half angles from 13 degrees on, a hundredth of it."""
        truth = [0.05, 0.12, 0.4, 0.1, 3.0, 9.0]
        scan = simulate(truth, noise=0.002, step=6)
        result = fit_scan(scan.select(scan.camera > 1))
        assert result.standard_deviation("ks") < 0.2 * result.value("ks")
        assert not {"ks", "inverse_sigma_s"} & set(result.undetermined)

    @pytest.mark.parametrize("seed", range(4))
    def test_materials_known_to_a_fifth(self, simulate: Simulate, seed: int) -> None:
        """Random materials as in the benchmark of coverage: by the Cramer-Rao bound, none is lost.

        Sixty a seed, and the four of other tests, with gains of 0.5 % and offsets of 0.02 degrees.
        """
        rng = np.random.default_rng((41, seed))
        errors = CommonErrors(light_angle_std_deg=0.02, gain_relative_std=0.005)
        truths = [SATIN, ROUGH, GLOSSY, NEEDLE]
        for _ in range(60):
            colours = [log_uniform(rng, 0.02, 0.9) for _ in range(3)]
            roughness = math.sqrt(rng.uniform(0.0, 0.8))
            lobe = [log_uniform(rng, 0.01, 20.0), 1 / log_uniform(rng, 0.01, 0.8)]
            truths.append([*colours, roughness, *lobe])
        lost, well_known = [], 0
        for number, truth in enumerate(truths):
            scan = simulate(
                truth,
                noise=log_uniform(rng, 0.002, 0.02),
                step=int(rng.integers(4, 9)),
                seed=number,
                gains=1 + 0.005 * rng.normal(size=(4, 3)),
                light_offset_deg=0.02 * rng.normal(size=3),
            )
            known = relative_bound(scan, truth, errors)[[0, 1, 2, 4]] < WELL_KNOWN
            well_known += int(known.sum())
            names = {n for n, k in zip(("kd_b", "kd_g", "kd_r", "ks"), known, strict=True) if k}
            lost += [(truth, names & unseen_names(fit_scan(scan, common_errors=errors)))]
        assert well_known > 3.8 * len(truths)
        assert not [case for case in lost if case[1]]


def relative_bound(scan: Observations, truth: list[float], errors: CommonErrors) -> np.ndarray:
    """Relative Cramer-Rao deviations (6,) of the internal coordinates at the truth."""
    problem = make_problem(scan, MODEL, {}, {})
    posterior = Posterior(problem, make_nuisances(problem, scan, errors))
    internal = MODEL.to_internal(truth)
    linearised = linearise_at(posterior, posterior.point(internal))
    known = estimate(problem, posterior.nuisances, linearised)
    with np.errstate(divide="ignore"):
        return np.asarray(np.sqrt(np.diag(known.random + known.common)) / np.abs(internal))
