"""What is physical about a model at given parameters: reciprocity, sign, albedos, energy.

A BRDF of a real surface is the same when light and view change places (Helmholtz), is never
negative, and scatters no more light than falls on it: its albedo (the directional-hemispherical
one) is at most 1 at every angle. Many published models break one of these somewhere; fits may use
them all the same, but should know.

Reciprocity and sign are tried on many pairs of directions, see `trials`; albedos are
integrated, see `albedo` and `bihemispherical`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..geometry import FloatArray
from ..models.base import ReflectanceModel
from .albedo import KINDS, Kind, directional_albedo, symmetries
from .bihemispherical import hemispherical_reflectance
from .trials import RECIPROCITY_LIMIT, SEARCH_DEG, AlbedoCurve, EnergyRange, Pair, try_pairs

ANGLES_DEG = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 80.0, 85.0, 89.0)
AZIMUTHS_DEG = (0.0, 45.0, 90.0, 135.0)
"""Of the light, where the model is not isotropic."""


@dataclass(frozen=True)
class AlbedoRow:
    """Albedo and its error at one angle, channels B, G, R."""

    kind: str
    theta_deg: float
    phi_deg: float
    value: tuple[float, ...]
    error: tuple[float, ...]


@dataclass(frozen=True)
class ModelReport:
    """What `check_model` found.

    Attributes
    ----------
    model, parameters
        Name, and published values by name.
    out_of_bounds
        Names of parameters outside the model's bounds: it promises nothing there.
    reciprocal, nonnegative
        What the model promises.
    isotropic
        Whether turning light and view together changes nothing.
    delta
        Whether an ideal mirror or refraction is part of it; reciprocity and sign are of the rest.
    reciprocity_defect
        Largest |f(l, v) - f(v, l)| / max(|f(l, v)|, |f(v, l)|) and where.
    smallest
        Smallest value and where, 1/sr.
    negative_share
        Share of pairs of directions (by solid angles) with a value below 0.
    albedo
        Directional-hemispherical, which is the hemispherical-directional one too where the model is
        reciprocal; else rows of that one follow.
    bihemispherical, bihemispherical_error
        Share of uniform light that is scattered, channels B, G, R.
    largest_albedo
        Over all angles, channels B, G, R.
    energy
        Where energy is created.
    findings
        What is remarkable, in words; empty where all is physical.
    """

    model: str
    parameters: dict[str, float]
    out_of_bounds: tuple[str, ...]
    reciprocal: bool
    nonnegative: bool
    isotropic: bool
    delta: bool
    reciprocity_defect: Pair
    smallest: Pair
    negative_share: float
    albedo: tuple[AlbedoRow, ...]
    bihemispherical: tuple[float, ...]
    bihemispherical_error: tuple[float, ...]
    largest_albedo: tuple[float, ...]
    energy: tuple[EnergyRange, ...]
    findings: tuple[str, ...]

    @property
    def creates_energy(self) -> bool:
        """Whether an albedo is above 1."""
        return bool(self.energy)

    @property
    def breaks_reciprocity(self) -> bool:
        """Whether the model is not reciprocal although it promises to be."""
        return self.reciprocal and self.reciprocity_defect.value > RECIPROCITY_LIMIT

    @property
    def breaks_sign(self) -> bool:
        """Whether a value is negative although the model promises that none is."""
        return self.nonnegative and not self.out_of_bounds and self.smallest.value < 0

    @property
    def good(self) -> bool:
        """Whether parameters are within bounds, no energy is created and promises are kept."""
        broken = self.breaks_reciprocity or self.breaks_sign
        return not (self.out_of_bounds or self.creates_energy or broken)

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain values."""
        return {
            **asdict(self),
            "creates_energy": self.creates_energy,
            "breaks_reciprocity": self.breaks_reciprocity,
            "breaks_sign": self.breaks_sign,
            "good": self.good,
        }


def check_model(
    model: ReflectanceModel,
    parameters: ArrayLike | None = None,
    *,
    angles_deg: Sequence[float] = ANGLES_DEG,
    tolerance: float = 1e-8,
) -> ModelReport:
    """Report how physical a model is at published values (p,), by default its typical ones.

    Parameters
    ----------
    model, parameters
        Reflectance model and published values.
    angles_deg
        Angles to the normal for the table of albedos, in [0, 90).
    tolerance
        Relative error of the albedos in the table. That of the bihemispherical reflectance is 100
        times as large, at most 1e-2, and at least 1e-3 where the model is not isotropic.

    Raises
    ------
    ValueError
        Parameters or angles outside the domain.
    """
    values = model.typical if parameters is None else np.asarray(parameters, dtype=np.float64)
    named = model.as_mapping(values)
    if not np.isfinite(model.to_internal(values)).all():
        raise ValueError(f"{model.name}: parameters {named} must be finite numbers")
    isotropic = symmetries(model, values).isotropic
    azimuths = (0.0,) if isotropic else AZIMUTHS_DEG
    tried = try_pairs(model, values)
    rows = tuple(
        row
        for kind in KINDS[: 1 if model.reciprocal else 2]
        for phi_deg in azimuths
        for row in _albedo_rows(model, values, angles_deg, phi_deg, kind, tolerance)
    )
    whole = hemispherical_reflectance(
        model, values, tolerance=max(min(100 * tolerance, 1e-2), 0.0 if isotropic else 1e-3)
    )
    curves = [AlbedoCurve(model, values, phi_deg) for phi_deg in azimuths]
    pairs = zip(model.parameters, values.tolist(), strict=True)
    report = ModelReport(
        model=model.name,
        parameters=named,
        out_of_bounds=tuple(p.name for p, value in pairs if not p.lower <= value <= p.upper),
        reciprocal=model.reciprocal,
        nonnegative=model.nonnegative,
        isotropic=isotropic,
        delta=model.delta,
        reciprocity_defect=tried.defect,
        smallest=tried.smallest,
        negative_share=tried.negative_share,
        albedo=rows,
        bihemispherical=_plain(whole.value),
        bihemispherical_error=_plain(whole.error),
        largest_albedo=tuple(max(c.largest(k)[1] for c in curves) for k in range(3)),
        energy=tuple(each for c in curves for k in range(3) for each in c.above_1(k)),
        findings=(),
    )
    return replace(report, findings=tuple(_findings(report, model)))


def _albedo_rows(
    model: ReflectanceModel,
    parameters: FloatArray,
    angles_deg: Sequence[float],
    phi_deg: float,
    kind: Kind,
    tolerance: float,
) -> Iterator[AlbedoRow]:
    found = directional_albedo(
        model,
        parameters,
        np.deg2rad(angles_deg),
        phi_i=np.deg2rad(phi_deg),
        kind=kind,
        tolerance=tolerance,
    )
    for theta_deg, value, error in zip(angles_deg, *found, strict=True):
        yield AlbedoRow(kind, float(theta_deg), phi_deg, _plain(value), _plain(error))


def _findings(report: ModelReport, model: ReflectanceModel) -> Iterator[str]:
    for p in model.parameters:
        if p.name in report.out_of_bounds:
            value = report.parameters[p.name]
            yield f"{p.name} = {value:g} lies outside its bounds {p.lower:g} to {p.upper:g}"
    if report.delta:
        yield "an ideal mirror or refraction is part of it: albedos count it, the rest does not"
    if not report.isotropic and model.isotropic:
        yield "not isotropic, although the model promises it"
    defect, smallest = report.reciprocity_defect, report.smallest
    if not report.reciprocal:
        yield f"not reciprocal, by definition: differs by up to {defect.value:.1%} ({defect})"
    elif report.breaks_reciprocity:
        yield f"not reciprocal, although the model promises it: {defect.value:.2g} ({defect})"
    if smallest.value < 0:
        share = f"{report.negative_share:.2%}" if report.negative_share else "few"
        share = f"below 0 in {share} of the pairs of directions"
        promise = ", although the model promises otherwise" if report.breaks_sign else ""
        yield f"{share}{promise}: {smallest.value:.3g} 1/sr ({smallest})"
    grouped: dict[tuple[Any, ...], list[str]] = {}
    for one in report.energy:
        key = (one.phi_deg, one.from_deg, one.to_deg, one.largest, one.largest_at_deg)
        grouped.setdefault(key, []).append(one.channel)
    for (phi, start, end, largest, at), channels in grouped.items():
        where = "" if report.isotropic else f" with light from azimuth {phi:g}"
        which = (
            "channel " + channels[0] if len(channels) == 1 else "channels " + ", ".join(channels)
        )
        least = "at least " if at == SEARCH_DEG[-1] else ""  # it may go on to rise
        yield (
            f"creates energy{where}: albedo above 1 from {start:.4g} to {end:.4g} degrees, reaches "
            f"{least}{largest:.4g} at {at:.4g} degrees in {which}"
        )


def _plain(values: FloatArray) -> tuple[float, ...]:
    return tuple(values.tolist())
