"""Scenes to search for the global optimum in: random ones over the whole range, and hard ones.

Each is made twice over: *true*, its data are of the model that is fitted, and *wrong*, they are of
GGX facets, or of cameras whose gains are off by 2 %, or both.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from tvbrdf_fitting.geometry import FloatArray, light_world_angle_deg
from tvbrdf_fitting.models import SURFACE
from tvbrdf_fitting.models.torrance_sparrow import SIGMA_S_BOUNDS
from tvbrdf_fitting.observations import Observations
from tvbrdf_launch.cli.bench.rig_scenes import log_uniform, measure

VERSION = 1
"""Of the scenes; cached reference results of another one are not used."""
GGX = "oren_nayar+cook_torrance(ggx)"
GAIN_STD = 0.02
ABSENT = 0.1
"""Share of scenes without a lobe, of those without a diffuse part, and of Lambertian ones."""
WRONGS = ("ggx", "gains", "ggx and gains")
TRUE = "true"


@dataclass(frozen=True, eq=False)
class Scene:
    """One scan and how it came about.

    Attributes
    ----------
    key
        What tells it from all others, and makes it again.
    observations
        What is fitted.
    truth
        Published values, of the model that is fitted; None where the data are of another.
    noise_free
        There is no noise in the data, so that the best cost may be 0.
    """

    key: str
    observations: Observations
    truth: FloatArray | None
    noise_free: bool = False


def random_scene(number: int, kind: str) -> Scene:
    """Return a random scene: any material within the bounds, any cameras, 12 to 361 lights."""
    rng = np.random.default_rng((17, number, (TRUE, *WRONGS).index(kind)))
    truth = any_material(rng)
    cameras = 1 + np.flatnonzero(rng.permutation(4) < rng.integers(1, 5))
    lights = int(rng.choice([12, 24, 46, 91, 181, 361]))
    phase, noise = rng.uniform(-0.5, 0.5), log_uniform(rng, 0.0005, 0.05)
    gains = 1 + GAIN_STD * rng.normal(size=(4, 3)) if "gains" in kind else None
    model = GGX if "ggx" in kind else SURFACE
    observations = measure(
        rng,
        as_ggx(rng, truth) if "ggx" in kind else truth,
        model=model,
        noise=noise,
        lights=lights,
        cameras=cameras.tolist(),
        phase=phase,
        gains=gains,
    )
    return Scene(f"random {number} {kind}", observations, truth if kind == TRUE else None)


def any_material(rng: np.random.Generator) -> FloatArray:
    """Return published values (6,) anywhere within the bounds, some of them exactly 0."""
    lambertian, dark, matte = (rng.random() < ABSENT for _ in range(3))
    return np.array(
        [
            *(0.0 if dark else log_uniform(rng, 0.01, 1.0) for _ in range(3)),
            0.0 if lambertian else 1.5 * rng.random(),
            0.0 if matte else log_uniform(rng, 0.001, 30.0),
            1 / log_uniform(rng, *SIGMA_S_BOUNDS),
        ]
    )


def as_ggx(rng: np.random.Generator, truth: FloatArray) -> FloatArray:
    """Return a GGX material (7,) with the same diffuse part and a lobe of about the same width."""
    kd_and_roughness, ks, inverse = truth[:4], truth[4], truth[5]
    strength = 0.0 if ks == 0 else log_uniform(rng, 0.02, 1.0)
    return np.array(
        [*kd_and_roughness, strength, min(max(1 / inverse, 0.006), 1.4), rng.uniform(1.1, 2.5)]
    )


Change = Callable[[Observations], Observations]
SATIN = (0.3, 0.5, 0.7, 0.4, 0.8, 6.0)
ROUGH = (0.6, 0.55, 0.5, 0.9, 0.15, 2.0)
SHARP = (0.3, 0.5, 0.7, 0.4, 3.0, 30.0)


@dataclass(frozen=True)
class HardCase:
    """What makes a scan hard.

    Attributes
    ----------
    truth
        Published values.
    lights, cameras, phase
        As in `measure`.
    change
        What is done to the observations.
    """

    truth: tuple[float, ...]
    lights: int = 121
    cameras: tuple[int, ...] = (1, 2, 3, 4)
    phase: float = 0.0
    change: Change = lambda observations: observations


def hidden(within_deg: float) -> Change:
    """Leave out what camera 1 sees around its specular peak."""

    def change(o: Observations) -> Observations:
        angle = light_world_angle_deg(o.light_direction)
        return o.select((o.camera != 1) | (np.abs(angle - 24) >= within_deg))

    return change


def saturated(above: float) -> Change:
    """Mask what is brighter, and keep at least something."""

    def change(o: Observations) -> Observations:
        dim = o.radiance < max(above, float(np.quantile(o.radiance, 0.2)))
        return replace(o, valid=o.valid & dim)

    return change


def dead(channel: int) -> Change:
    """Mask a channel."""

    def change(o: Observations) -> Observations:
        valid = o.valid.copy()
        valid[:, channel] = False
        return replace(o, valid=valid)

    return change


def outliers(o: Observations) -> Observations:
    """Double every fifth value."""
    stray = np.random.default_rng(3).random(o.radiance.shape) < 0.2
    return replace(o, radiance=o.radiance * (1 + stray))


def constant(o: Observations) -> Observations:
    """The same radiance in every direction."""
    return replace(o, radiance=np.full(o.radiance.shape, 0.5))


def zero(o: Observations) -> Observations:
    """No light at all."""
    return replace(o, radiance=np.zeros(o.radiance.shape))


def negative(o: Observations) -> Observations:
    """Everything below zero."""
    return replace(o, radiance=-o.radiance)


def scaled(factor: float) -> Change:
    """Another radiometric scale."""
    return lambda o: replace(
        o, radiance=o.radiance * factor, variance=np.maximum(o.variance * factor**2, 1e-300)
    )


HARD: dict[str, HardCase] = {
    "narrower than the step": HardCase((0.3, 0.5, 0.7, 0.4, 20.0, 150.0), lights=181),
    "seen by hardly a value": HardCase((0.3, 0.5, 0.7, 0.4, 20.0, 150.0), lights=46, phase=0.2),
    "missed between two lights": HardCase((0.3, 0.5, 0.7, 0.4, 20.0, 199.0), lights=19),
    "narrower than the bound": HardCase((0.3, 0.5, 0.7, 0.4, 20.0, 400.0), lights=361),
    "at the narrow bound": HardCase((0.3, 0.5, 0.7, 0.4, 20.0, 200.0), lights=361),
    "at the wide bound": HardCase((0.3, 0.5, 0.7, 0.4, 0.5, 1 / 1.5)),
    "as wide as the diffuse part": HardCase((0.3, 0.5, 0.7, 0.9, 0.4, 0.8)),
    "Ks = 0": HardCase((0.3, 0.5, 0.7, 0.4, 0.0, 6.0)),
    "Ks = 0, Lambertian": HardCase((0.3, 0.5, 0.7, 0.0, 0.0, 6.0)),
    "Ks as small as the noise": HardCase((0.3, 0.5, 0.7, 0.4, 0.002, 12.0)),
    "Kd = 0": HardCase((0.0, 0.0, 0.0, 0.4, 2.0, 8.0)),
    "Kd = 0 in two channels": HardCase((0.0, 0.0, 0.6, 0.4, 2.0, 8.0)),
    "rough to the bound": HardCase((0.9, 0.9, 0.9, 1.5, 0.3, 5.0)),
    "hidden peak": HardCase(SATIN, change=hidden(10)),
    "hidden lobe": HardCase(SHARP, change=hidden(13)),
    "saturated peak": HardCase(SATIN, change=saturated(0.8)),
    "saturated sharp peak": HardCase(SHARP, change=saturated(0.8)),
    "camera 1 only": HardCase(SATIN, cameras=(1,)),
    "camera 2 only": HardCase(SATIN, cameras=(2,)),
    "camera 3 only": HardCase(SATIN, cameras=(3,)),
    "camera 4 only": HardCase(SATIN, cameras=(4,)),
    "camera 4 only, rough": HardCase(ROUGH, cameras=(4,)),
    "ten lights": HardCase(SATIN, lights=11),
    "ten lights, sharp": HardCase(SHARP, lights=11, phase=0.3),
    "ten lights, one camera": HardCase(SATIN, lights=11, cameras=(1,)),
    "dead blue": HardCase(SATIN, change=dead(0)),
    "dead green": HardCase(SHARP, change=dead(1)),
    "outliers": HardCase(SATIN, change=outliers),
    "constant": HardCase(SATIN, lights=61, change=constant),
    "zeros": HardCase(SATIN, lights=61, change=zero),
    "negative": HardCase(SATIN, lights=61, change=negative),
    "scale 1e-6": HardCase(SATIN, lights=61, change=scaled(1e-6)),
    "scale 1e6": HardCase(SATIN, lights=61, change=scaled(1e6)),
}
HARD_NOISES = (0.0, 0.0005, 0.005, 0.05)


def hard_scenes(kinds: tuple[str, ...] = (TRUE, *WRONGS)) -> Iterator[str]:
    """Keys of the hard scenes of some kinds."""
    for kind in kinds:
        for name in HARD:
            for noise in HARD_NOISES:
                yield f"hard {name}|{noise:g}|{kind}"


def make_scene(key: str) -> Scene:
    """Return a scene by its key."""
    word, rest = key.split(" ", 1)
    if word == "random":
        number, kind = rest.split(" ", 1)
        return random_scene(int(number), kind)
    name, text, kind = rest.split("|")
    case, noise = HARD[name], float(text)
    place = [*HARD].index(name)
    rng = np.random.default_rng((19, place, (TRUE, *WRONGS).index(kind), int(1e5 * noise)))
    truth = np.array(case.truth)
    gains = 1 + GAIN_STD * rng.normal(size=(4, 3)) if "gains" in kind else None
    observations = measure(
        rng,
        as_ggx(rng, truth) if "ggx" in kind else truth,
        model=GGX if "ggx" in kind else SURFACE,
        noise=noise,
        lights=case.lights,
        cameras=case.cameras,
        phase=case.phase,
        gains=gains,
    )
    spoilt = case.change in {outliers, constant, zero, negative} or "scale" in name
    known = kind == TRUE and not spoilt and case.truth[5] <= 1 / SIGMA_S_BOUNDS[0]
    exact = noise == 0 or case.change is zero
    return Scene(key, case.change(observations), truth if known else None, exact)
