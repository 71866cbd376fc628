"""The simulated sensor's noise: what a patch averages must have exactly the right distribution."""

from __future__ import annotations

import numpy as np
import pytest

from tvbrdf_nodes.camera.driver import Region
from tvbrdf_nodes.camera.simulated_image import Bands, ImageMaker, SimulatedCameraParameters
from tvbrdf_nodes.camera.simulated_noise import BLOCK, FrameDraws, NoiseField, generator
from tvbrdf_nodes.world.scene import CameraEffects

NOISY = CameraEffects(shot_noise=True, read_noise=True, quantisation=True)
SIGMAS = 3.89
"""Of a normal distribution: 1 in 10 000 lies beyond."""
BLOCKS = 20
FRAMES = BLOCKS * BLOCK


def maker(effects: CameraEffects = NOISY, **parameters: object) -> ImageMaker:
    return ImageMaker(SimulatedCameraParameters(camera=1, **parameters), effects, seed=7)  # type: ignore[arg-type]


def full_bands(width: int = 128, height: int = 128) -> Bands:
    return Bands(Region(0, 0, width, height), height)


def all_draws(field: NoiseField, bands: Bands, key: tuple[int, int] = (3, 4)) -> list[FrameDraws]:
    return [
        draws
        for block in range(BLOCKS)
        for draws in field.draws(key, block, bands.edges, bands.width)
    ]


@pytest.fixture(scope="module")
def patch_statistics() -> tuple[np.ndarray, np.ndarray]:
    """Standardised mean, and variance over its expectation, of each frame, band and channel."""
    camera, bands = maker(), full_bands()
    signal_dn = np.array([[1500.0, 700.0, 90.0], [300.0, 1200.0, 2500.0]])
    gain_e_per_dn = 10_000.0 / (4095.0 - 64.0)
    # shot noise has the variance of the electrons; rounding adds 1/12
    variance = signal_dn / gain_e_per_dn + (5.0 / gain_e_per_dn) ** 2 + 1.0 / 12.0
    means, variances = [], []
    for draws in all_draws(camera.noise, bands):
        image = camera.make(bands, signal_dn, draws).astype(np.float64)
        parts = [image[:112].reshape(-1, 3), image[112:].reshape(-1, 3)]
        counts = np.array([[len(part)] for part in parts])
        deviation = np.array([part.mean(axis=0) for part in parts]) - (signal_dn + 64.0)
        means.append(deviation / np.sqrt(variance / counts))
        variances.append(np.array([part.var(axis=0, ddof=1) for part in parts]) / variance)
    return np.array(means), np.array(variances)


def test_patch_mean_has_right_mean_and_spread(
    patch_statistics: tuple[np.ndarray, np.ndarray],
) -> None:
    standard = patch_statistics[0].reshape(-1)
    assert abs(standard.mean()) < SIGMAS / np.sqrt(standard.size)
    assert abs(standard.var() - 1.0) < SIGMAS * np.sqrt(2.0 / standard.size)


def test_patch_means_are_independent_from_frame_to_frame(
    patch_statistics: tuple[np.ndarray, np.ndarray],
) -> None:
    standard = patch_statistics[0].reshape(FRAMES, -1)
    for lag in (1, 2, 3):
        correlation = (standard[lag:] * standard[:-lag]).mean()
        assert abs(correlation) < SIGMAS / np.sqrt(standard[lag:].size), lag


def test_channels_and_bands_are_independent(
    patch_statistics: tuple[np.ndarray, np.ndarray],
) -> None:
    standard = patch_statistics[0].reshape(FRAMES, -1)
    correlation = np.corrcoef(standard.T)
    off_diagonal = correlation[~np.eye(6, dtype=bool)]
    assert np.abs(off_diagonal).max() < SIGMAS / np.sqrt(FRAMES)


@pytest.mark.parametrize("band", [0, 1])
def test_patch_variance_is_that_of_independent_pixels(
    patch_statistics: tuple[np.ndarray, np.ndarray], band: int
) -> None:
    """Its mean is 1, its variance 2 / (n - 1), as of a chi-square distribution over n - 1."""
    pixels = (112 * 128, 16 * 128)[band]
    ratio = patch_statistics[1][:, band].reshape(-1)
    spread = np.sqrt(2.0 / (pixels - 1))
    assert abs(ratio.mean() - 1.0) < SIGMAS * spread / np.sqrt(ratio.size)
    # a ratio's squared deviation has relative variance 2 (it is nearly normal)
    relative = (ratio - 1.0) / spread
    assert abs((relative**2).mean() - 1.0) < SIGMAS * np.sqrt(2.0 / ratio.size)


def test_pixels_of_different_frames_are_uncorrelated() -> None:
    field = NoiseField(1, 1, 64, 64)
    images = []
    for draws in field.draws((0, 0), 0, (0, 64), 64):
        window = field.window(draws.row, draws.column, 64, 64).reshape(64, 64, 3)
        images.append(draws.scale[0] * window + draws.shift[0])
    flat = np.array(images).reshape(BLOCK, -1)
    correlation = flat @ flat.T / flat.shape[1]
    # windows that overlap without coinciding are as uncorrelated as fresh ones
    pairs = correlation[np.triu_indices(BLOCK, 1)]
    assert np.abs(pairs).max() < 5.0 / np.sqrt(flat.shape[1])
    assert abs(pairs.mean()) < SIGMAS / np.sqrt(flat.shape[1] * pairs.size)


def test_pixels_are_normal() -> None:
    from scipy import stats

    field = NoiseField(2, 1, 64, 64)
    draws = field.draws((0, 0), 0, (0, 64), 64)[0]
    window = field.window(draws.row, draws.column, 64, 64).reshape(-1, 3)
    pixels = draws.scale[0] * window + draws.shift[0]
    for channel in range(3):
        assert stats.kstest(pixels[:, channel], "norm").pvalue > 1e-4


def test_draws_depend_on_the_key_and_on_nothing_else() -> None:
    one, other = NoiseField(5, 2, 16, 16), NoiseField(5, 2, 16, 16)
    first = one.draws((8, 9), 1, (0, 14, 16), 16)
    one.draws((1, 1), 0, (0, 16), 16)
    again = other.draws((8, 9), 1, (0, 14, 16), 16)
    assert np.array_equal(one.values, other.values)
    for a, b in zip(first, again, strict=True):
        assert a[:2] == b[:2]
        assert np.array_equal(a.scale, b.scale)
        assert np.array_equal(a.shift, b.shift)
        assert (a.flicker, a.jitter) == (b.flicker, b.jitter)
    for key in ((8, 10), (9, 9)):
        assert one.draws(key, 1, (0, 14, 16), 16)[0].flicker != first[0].flicker
    assert one.draws((8, 9), 0, (0, 14, 16), 16)[0].flicker != first[0].flicker
    assert NoiseField(5, 3, 16, 16).draws((8, 9), 1, (0, 14, 16), 16)[0].flicker != first[0].flicker


def test_generators_of_different_purposes_differ() -> None:
    numbers = {generator(1, camera, purpose).random() for camera in (1, 2) for purpose in range(4)}
    assert len(numbers) == 8


def test_a_frame_of_one_row_and_one_pixel_has_finite_noise() -> None:
    camera = maker(width=1, height=2)
    bands = Bands(Region(0, 0, 1, 1), 2)
    for draws in camera.noise.draws((0, 0), 0, bands.edges, 1):
        image = camera.make(bands, np.full((1, 3), 1000.0), draws)
        assert abs(int(image[0, 0, 0]) - 1064) < 6 * 21


@pytest.mark.parametrize("depth", [8, 12, 16])
def test_saturated_pixels_have_the_largest_code(depth: int) -> None:
    camera, bands = maker(bit_depth=depth), full_bands()
    top = 2**depth - 1
    signal_dn = np.full((2, 3), 3.0 * top)
    image = camera.make(bands, signal_dn, camera.noise.draws((0, 0), 0, bands.edges, 128)[0])
    assert image.dtype == (np.uint8 if depth == 8 else np.uint16)
    assert (image == top).all()


def test_partly_saturated_frame_is_cut_off_at_the_largest_code() -> None:
    camera, bands = maker(), full_bands()
    signal_dn = np.full((2, 3), 4095.0 - 64.0)
    image = camera.make(bands, signal_dn, camera.noise.draws((0, 0), 0, bands.edges, 128)[0])
    assert image.max() == 4095
    # half of the pixels would be above; their share is binomial
    share = (image == 4095).mean()
    assert abs(share - 0.5) < 0.02


def test_dark_pixels_do_not_wrap_round() -> None:
    camera, bands = maker(black_level_dn=0.0), full_bands()
    image = camera.make(bands, np.zeros((2, 3)), camera.noise.draws((0, 0), 0, bands.edges, 128)[0])
    assert image.max() < 20


def test_gamma_response_is_undone_by_its_inverse() -> None:
    """Noise is added to the light, before the response: linearised codes have the linear mean."""
    from tvbrdf_fitting.measurement.response import Response

    camera, bands = maker(response="gamma", bit_depth=16), full_bands()
    signal_dn = camera.signal_dn(np.full((2, 3), 0.7), 4.0)
    image = camera.make(bands, signal_dn, camera.noise.draws((0, 0), 0, bands.edges, 128)[0])
    linear = Response("gamma", 0.4545).linearise(image, 16)
    ratio = 65535.0 / 4095.0
    variance_dn2 = (0.7 * 4.0 * 604.65 / (10_000.0 / 4031.0) + (5.0 / 2.4808) ** 2) * ratio**2
    expected = 64.0 * ratio + 0.7 * 4.0 * 604.65 * ratio
    tolerance = SIGMAS * np.sqrt(variance_dn2 / (112 * 128))
    assert np.abs(linear[:112].mean(axis=(0, 1)) - expected).max() < tolerance


def test_unquantised_image_is_float32_and_exact_without_noise() -> None:
    camera, bands = maker(CameraEffects()), full_bands()
    signal_dn = np.array([[1.2345, 100.0, 3000.0], [5.0, 6.0, 7.0]])
    image = camera.make(bands, signal_dn, camera.noise.draws((0, 0), 0, bands.edges, 128)[0])
    assert image.dtype == np.float32
    assert np.allclose(image[0, 0], 64.0 + signal_dn[0], rtol=6e-8)
    assert np.allclose(image[-1, -1], 64.0 + signal_dn[1], rtol=6e-8)


def test_full_scale_is_used_as_documented() -> None:
    """White, facing the light, 4 ms: 60 % of the codes above the black level."""
    camera = maker()
    signal_dn = camera.signal_dn(np.ones(3), 4.0)
    assert signal_dn == pytest.approx(0.6 * (4095 - 64) * np.ones(3), rel=1e-5)
