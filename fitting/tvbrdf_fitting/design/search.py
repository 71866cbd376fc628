"""How few lights, cameras and exposures reach a wanted accuracy of a given material.

For every choice of cameras and of exposures, the smallest number of evenly spaced lights is sought
at which every parameter's predicted deviation (`fisher_information`) is as wanted. Where the lights
stand against a sharp peak is chance, as cameras run free while the arm moves: the worst of
`PHASES` counts. Deviations do not fall strictly with the number of lights, so that the answer of
the bisection is checked: numbers up to a quarter larger must reach the accuracy too.

A design takes the model for right: so few lights can't show that it is wrong, and a material that
is new needs more. Predictions are to first order. Noisy scans of a design may turn out not to reach
the accuracy, as where a peak is known by its flanks only: see `simulation`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, combinations
from typing import Any

import numpy as np

from ..geometry import FloatArray
from ..inference.nuisances import CommonErrors
from ..models import ReflectanceModel, get_model
from ..models.base import ARTANH, SQUARE
from .fisher_information import Deviations, Information, Rig

PHASES = (0.125, 0.375, 0.625, 0.875)
MOST_LIGHTS = 361
"""Of one sweep at the cameras' rate."""
RELATIVE_ACCURACY, ANGLE_ACCURACY = 0.05, 0.03
SMALLEST_SCALE = 0.02
"""A relative accuracy is of a value at least this large, or none would do for a value of 0."""
_WINDOW, _WINDOW_CHECKS = 1.25, 6
_TOO_MANY_LIGHTS = 100_000


@dataclass(frozen=True)
class Accuracy:
    """A wanted standard deviation, published units, or a part of the value; infinite for any."""

    deviation: float
    relative: bool = False

    def of(self, value: float) -> float:
        """Return the deviation allowed of a value."""
        scale = max(abs(value), SMALLEST_SCALE) if self.relative else 1.0
        return self.deviation * scale


@dataclass(frozen=True, eq=False)
class Design:
    """Cameras, exposures and lights, and what a fit would then know.

    Attributes
    ----------
    cameras, exposures_ms, lights
        One sweep an exposure, each with so many lights.
    time_s
        Of all sweeps.
    phase
        Where the lights stand in their parts of the sweep, when they do worst.
    predicted
        Deviations there.
    ratio
        Largest deviation over what was wanted.
    """

    cameras: tuple[int, ...]
    exposures_ms: tuple[float, ...]
    lights: int
    time_s: float
    phase: float
    predicted: Deviations
    ratio: float

    @property
    def frames(self) -> int:
        """Frames of each camera: lights times exposures."""
        return self.lights * len(self.exposures_ms)

    @property
    def images(self) -> int:
        """Frames of all cameras."""
        return self.frames * len(self.cameras)


@dataclass(frozen=True)
class Shortfall:
    """A parameter that no design knows well enough.

    `common_share` is the part of its variance that comes from errors that frames share, of which
    more frames take nothing away.
    """

    name: str
    deviation: float
    wanted: float
    common_share: float

    def __str__(self) -> str:
        if math.isinf(self.deviation):
            return f"{self.name} is not determined at all"
        text = (
            f"{self.name} is known to {self.deviation:.3g} at best, {self.wanted:.3g} is wanted "
            f"({self.deviation / self.wanted:.3g} times too coarse)"
        )
        if self.common_share > 0.5:
            text += (
                f"; {self.common_share:.0%} of its variance are errors that frames share, which "
                f"more of them do not average out"
            )
        return text


@dataclass(frozen=True, eq=False)
class DesignStudy:
    """Which designs reach an accuracy.

    Attributes
    ----------
    information
        Material and rig.
    wanted
        Deviation allowed of each free parameter, published units, by name.
    most_lights
        Largest number of lights in a sweep.
    designs
        None of them has another one that is as good in frames, cameras and time, and better in one;
        by the number of images.
    largest
        The design with all cameras, exposures and lights.
    shortfalls
        Parameters that the largest design does not know well enough; then there are no designs.
    """

    information: Information
    wanted: Mapping[str, float]
    most_lights: int
    designs: tuple[Design, ...]
    largest: Design
    shortfalls: tuple[Shortfall, ...]

    @property
    def fewest(self) -> Design | None:
        """The design with the fewest images; None where none reaches the accuracy."""
        return self.designs[0] if self.designs else None

    def reason(self) -> str:
        """Why no design reaches the accuracy, in words; empty where one does."""
        if self.fewest is not None:
            return ""
        design = self.largest
        told = "; ".join(map(str, self.shortfalls)) or "it is missed for some places of the lights"
        return (
            f"no design reaches the accuracy: with cameras {_listed(design.cameras)}, exposures of "
            f"{_listed(design.exposures_ms)} ms and {design.lights} lights {told}"
        )


def default_accuracy(model: ReflectanceModel) -> dict[str, Accuracy]:
    """Accuracy by name: 0.03 rad for sigma_d, 0.03 for g, 5 % for amplitudes, widths and others."""
    angle, part = Accuracy(ANGLE_ACCURACY), Accuracy(RELATIVE_ACCURACY, relative=True)
    return {p.name: angle if p.transform in {SQUARE, ARTANH} else part for p in model.parameters}


def meaningless(model: ReflectanceModel, values: FloatArray) -> tuple[str, ...]:
    """Parameters of this material that nothing depends on: a lobe's width without its amplitude."""
    at = model.as_mapping(values)
    return tuple(
        p.name
        for p in model.parameters
        if any(all(at[name] == 0 for name in group) for group in p.carried_by)
    )


def find_designs(
    model: str | ReflectanceModel,
    parameters: Mapping[str, float],
    *,
    rig: Rig | None = None,
    accuracy: Mapping[str, Accuracy] | None = None,
    cameras: Sequence[int] | None = None,
    exposures_ms: Sequence[float] = (0.2, 4.0, 32.0),
    fixed: Sequence[str] = (),
    common_errors: CommonErrors | None = None,
    most_lights: int = MOST_LIGHTS,
) -> DesignStudy:
    """Find the designs with the fewest lights, cameras and exposures that reach an accuracy.

    Parameters
    ----------
    model, parameters
        The material: a model's name, and its published values by name, as of a fit's `model` and
        `parameters`.
    rig
        Geometry and noise; by default the paper's, with the simulated cameras' noise.
    accuracy
        By name, instead of `default_accuracy`.
    cameras, exposures_ms
        Of which any may be left out.
    fixed
        Names of parameters that are known. Those that nothing depends on (`meaningless`) are too.
    common_errors
        Errors that frames share, as for `fit_scan`.
    most_lights
        Largest number of lights in a sweep, at most 100 000.

    Raises
    ------
    FitError
        The rig's directions cannot determine the model.
    ValueError
        Unknown names or cameras, values that the model does not allow, nothing to choose from or
        to find out.
    """
    chosen = get_model(model) if isinstance(model, str) else model
    values = chosen.from_mapping(parameters)
    _refuse_what_is_not_known(chosen, values, [*(accuracy or {}), *fixed])
    rig = rig or Rig()
    numbers = tuple(sorted(set(rig.cameras if cameras is None else cameras)))
    exposures = tuple(sorted({float(e) for e in exposures_ms}))
    unknown = [number for number in numbers if number not in rig.cameras]
    if unknown or not numbers or not exposures or not all(0 < e < math.inf for e in exposures):
        raise ValueError(
            f"no design of cameras {[*numbers]} (the rig has {[*rig.cameras]}) and exposures of "
            f"{[*exposures]} ms: give at least one of each, exposures above 0"
        )
    if not 1 <= most_lights <= _TOO_MANY_LIGHTS:
        raise ValueError(
            f"most_lights = {most_lights}: at least one is needed, more than {_TOO_MANY_LIGHTS} "
            f"take too long"
        )
    known = tuple(dict.fromkeys([*fixed, *meaningless(chosen, values)]))
    every = default_accuracy(chosen) | dict(accuracy or {})
    wanted = {n: every[n].of(float(parameters[n])) for n in every if n not in known}
    if not any(math.isfinite(deviation) for deviation in wanted.values()):
        raise ValueError(f"nothing is wanted of {chosen.name}: every parameter is fixed or any")
    information = Information(
        rig, chosen, values, exposures, fixed=known, common_errors=common_errors
    )
    search = _Search(information, wanted, most_lights)
    found = search.all(numbers, exposures)
    designs = tuple(sorted(_pareto(found), key=lambda d: (d.images, len(d.cameras), d.time_s)))
    largest = search.design(numbers, exposures, most_lights)
    return DesignStudy(
        information=information,
        wanted=wanted,
        most_lights=most_lights,
        designs=designs,
        largest=largest,
        shortfalls=() if designs else tuple(_shortfalls(information, wanted, largest)),
    )


def _refuse_what_is_not_known(
    model: ReflectanceModel, values: FloatArray, names: Sequence[str]
) -> None:
    for name in names:
        if name not in model.parameter_names:
            raise ValueError(
                f"{model.name} has no parameter {name!r}; it has {_listed(model.parameter_names)}"
            )
    for parameter, value in zip(model.parameters, values.tolist(), strict=True):
        if not parameter.lower <= value <= parameter.upper:
            raise ValueError(
                f"material: {parameter.name} = {value:g} is outside [{parameter.lower:g}, "
                f"{parameter.upper:g}] {parameter.unit}"
            )


def make_design(
    information: Information,
    wanted: Mapping[str, float],
    cameras: tuple[int, ...],
    exposures_ms: tuple[float, ...],
    lights: int,
) -> Design:
    """Return a design with its predictions where the lights stand worst."""
    names = information.model.parameter_names
    places, allowed = [names.index(name) for name in wanted], np.array([*wanted.values()])
    known = [information.deviations(cameras, exposures_ms, lights, phase) for phase in PHASES]
    some = np.isfinite(allowed)  # infinite where anything will do
    ratios = [float(np.max(d.published[places][some] / allowed[some], initial=0.0)) for d in known]
    worst = int(np.argmax(ratios))
    return Design(
        cameras=cameras,
        exposures_ms=exposures_ms,
        lights=lights,
        time_s=information.rig.time_s(lights, exposures_ms),
        phase=PHASES[worst],
        predicted=known[worst],
        ratio=ratios[worst],
    )


class _Search:
    """Fewest lights of each choice of cameras and exposures."""

    def __init__(
        self, information: Information, wanted: Mapping[str, float], most_lights: int
    ) -> None:
        self._information, self._wanted, self._most = information, wanted, most_lights
        self._known: dict[tuple[Any, ...], Design] = {}

    def design(
        self, cameras: tuple[int, ...], exposures_ms: tuple[float, ...], lights: int
    ) -> Design:
        """Return a design, made once."""
        key = (cameras, exposures_ms, lights)
        if key not in self._known:
            self._known[key] = make_design(self._information, self._wanted, *key)
        return self._known[key]

    def all(self, cameras: tuple[int, ...], exposures_ms: tuple[float, ...]) -> list[Design]:
        """Return the smallest design of each choice, but for those that a smaller choice beats."""
        found: list[Design] = []
        for some in _choices(cameras):
            for times in _choices(exposures_ms):
                least_time_s = self._information.rig.time_s(1, times)
                beaten = [
                    d.frames // len(times)
                    for d in found
                    if len(d.cameras) <= len(some) and d.time_s <= least_time_s
                ]
                lights = self._fewest(some, times, min(beaten, default=self._most))
                if lights is not None:
                    found.append(self.design(some, times, lights))
        return found

    def _fewest(
        self, cameras: tuple[int, ...], exposures_ms: tuple[float, ...], most: int
    ) -> int | None:
        """Return the smallest number of lights up to `most` that reaches the accuracy for sure."""

        def reaches(lights: int) -> bool:
            return self.design(cameras, exposures_ms, lights).ratio <= 1.0

        if most < 1 or not reaches(most):
            return None
        missed = 0
        while missed < most:
            low, high = missed, missed + 1
            while not reaches(high):
                low, high = high, min(high + max(1, high // 4), most)
            while high - low > 1:
                middle = (low + high) // 2
                low, high = (low, middle) if reaches(middle) else (middle, high)
            missed = max((n for n in self._checked(high) if not reaches(n)), default=0)
            if not missed:
                return high
        return None

    def _checked(self, lights: int) -> list[int]:
        """Larger numbers of lights that must do as well."""
        last = min(math.ceil(_WINDOW * lights), self._most)
        return sorted({round(n) for n in np.linspace(lights, last, _WINDOW_CHECKS)} - {lights})


def _choices(items: tuple[Any, ...]) -> Iterator[tuple[Any, ...]]:
    """Every choice of at least one, smaller ones first."""
    return chain.from_iterable(combinations(items, k) for k in range(1, len(items) + 1))


def _pareto(designs: Sequence[Design]) -> list[Design]:
    """Return designs to which none is equal or better in frames, cameras and time."""
    kept: list[Design] = []
    # of designs alike in all three the one with the larger margin stands for them
    for design in sorted(designs, key=lambda d: (*_cost(d), d.ratio)):
        if not any(all(a <= b for a, b in zip(_cost(k), _cost(design), strict=True)) for k in kept):
            kept.append(design)
    return kept


def _cost(design: Design) -> tuple[float, ...]:
    return design.frames, len(design.cameras), design.time_s


def _shortfalls(
    information: Information, wanted: Mapping[str, float], design: Design
) -> Iterator[Shortfall]:
    for name, allowed in wanted.items():
        place = information.model.parameter_names.index(name)
        deviation = float(design.predicted.published[place])
        if deviation > allowed:
            yield Shortfall(name, deviation, allowed, float(design.predicted.common_share[place]))


def _listed(items: Sequence[Any]) -> str:
    return ", ".join(f"{i:g}" if isinstance(i, float) else str(i) for i in items)
