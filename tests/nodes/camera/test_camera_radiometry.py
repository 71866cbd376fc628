"""The simulated camera: from radiance to codes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.nodes.camera.simulated_frames import TAG, MakeBench, middle_ns
from tvbrdf_fitting.geometry import CAMERA_ANGLES_DEG, light_direction, view_direction
from tvbrdf_fitting.models import get_model
from tvbrdf_messages.messages import SimMotion
from tvbrdf_nodes.camera.driver import CameraSettings, Region
from tvbrdf_nodes.camera.simulated_bench import (
    ZERO_NS,
    resting_light,
    sweeping_light,
)
from tvbrdf_nodes.core.device import DeviceError
from tvbrdf_nodes.world.sample import make_sample
from tvbrdf_nodes.world.scene import CameraEffects, LampEffects

BLACK_DN, DN_PER_RADIANCE_MS = 64.0, 604.65


def test_mean_codes_follow_the_formula(make_bench: MakeBench, folder: Path) -> None:
    """Ideal scene: black + radiance·exposure·constant to 1e-6 (float32 images: 6e-8)."""
    sample = make_sample({"kind": "measured", "path": str(folder)})
    for camera in (2, 4):
        bench = make_bench(motion=sweeping_light(-60.0, 15.0), camera=camera, exposure_ms=2.0)
        for frame in bench.frames(200, TAG):
            angle_deg = -60.0 + 15.0 * (middle_ns(frame) - ZERO_NS) * 1e-9
            radiance = sample.radiance(camera, np.array([angle_deg]), 0.0, 1)[0]
            cosine = max(np.cos(np.deg2rad(angle_deg - 12.0)), 0.0)
            grey = np.array([0.7410, 0.7438, 0.752]) * cosine
            for rows, value in ((slice(0, 28), radiance), (slice(28, 32), grey)):
                expected = BLACK_DN + DN_PER_RADIANCE_MS * 2.0 * value
                mean = frame.image[rows].mean(axis=(0, 1), dtype=np.float64)
                assert mean == pytest.approx(np.minimum(expected, 4095.0), rel=1e-6)


CONSTANT: dict[str, Any] = {
    "kind": "constant",
    "model": "ON+TS",
    "parameters": {
        "kd_b": 0.1,
        "kd_g": 0.2,
        "kd_r": 0.5,
        "sigma_d": 0.4,
        "ks": 0.3,
        "inverse_sigma_s": 4.0,
    },
}


def brdf_cosine(light: np.ndarray, view: np.ndarray) -> np.ndarray:
    """π·BRDF·cosθi of the constant material, straight from the model."""
    model = get_model("ON+TS")
    values = model.from_mapping(CONSTANT["parameters"])
    return np.asarray(np.pi * model.evaluate(light, view, values) * light[:, 2:])


@pytest.mark.parametrize("camera", [1, 3])
def test_mean_codes_of_an_analytic_material_follow_its_model(
    make_bench: MakeBench, camera: int
) -> None:
    bench = make_bench(motion=sweeping_light(-70.0, 40.0), camera=camera, sample=CONSTANT)
    frames = bench.frames(100, TAG)
    seconds = (np.array([middle_ns(frame) for frame in frames]) - ZERO_NS) * 1e-9
    angles = -70.0 + 40.0 * seconds
    light = light_direction(angles)
    view = np.broadcast_to(view_direction(CAMERA_ANGLES_DEG[camera - 1]), light.shape)
    codes = BLACK_DN + DN_PER_RADIANCE_MS * 4.0 * brdf_cosine(light, view)
    means = np.array([frame.image[:28].mean(axis=(0, 1), dtype=float) for frame in frames])
    seen = (np.abs(angles) > 1.6) & (angles < 90.0)
    assert np.allclose(means[seen], np.minimum(codes, 4095.0)[seen], rtol=1e-6)


def test_near_field_turns_the_directions_over_the_tray(make_bench: MakeBench) -> None:
    """Each pixel against its own directions; bilinear between 9 x 9 places is good to 1e-3."""
    angle_deg, camera = 25.0, 2
    bench = make_bench(
        CameraEffects(near_field=True), resting_light(angle_deg), camera=camera, sample=CONSTANT
    )
    image = bench.frames(1, TAG)[0].image
    x, y = np.meshgrid((np.arange(32) + 0.5) / 16 - 1, 1 - (np.arange(28) + 0.5) / 14)
    places_cm = 2.54 * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    light = 44.0 * light_direction(angle_deg) - places_cm
    view = 94.0 * view_direction(CAMERA_ANGLES_DEG[camera - 1]) - places_cm
    light /= np.linalg.norm(light, axis=1, keepdims=True)
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    codes = BLACK_DN + DN_PER_RADIANCE_MS * 4.0 * brdf_cosine(light, view).reshape(28, 32, 3)
    assert np.allclose(image[:28], codes, rtol=1e-3)
    assert np.ptp(image[:28, :, 2]) > 0.05 * codes[..., 2].max()
    # the reference piece stays flat
    assert np.ptp(image[28:].reshape(-1, 3), axis=0).max() == 0


def test_near_field_with_noise_blur_and_region(make_bench: MakeBench) -> None:
    """All effects together: the mean over frames comes to the picture without them."""
    motion = resting_light(25.0)
    clean = make_bench(CameraEffects(near_field=True), motion, sample=CONSTANT).frames(1, TAG)
    effects = CameraEffects(
        near_field=True, motion_blur=True, shot_noise=True, read_noise=True, quantisation=True
    )
    bench = make_bench(effects, motion, sample=CONSTANT)
    region = Region(4, 8, 20, 22)
    bench.driver.configure(CameraSettings(exposure_ms=4.0, frame_rate_hz=30.0, region=region))
    frames = np.array([frame.image for frame in bench.frames(200, TAG)], dtype=float)
    expected = clean[0].image[8:30, 4:24].astype(float)
    gain = 10_000.0 / 4031.0
    sigma = np.sqrt((expected - BLACK_DN) / gain + (5.0 / gain) ** 2 + 1 / 12)
    standard = (frames.mean(axis=0) - expected) / (sigma / np.sqrt(200))
    assert np.abs(standard).max() < 5.0
    assert abs(standard.mean()) < 3.89 / np.sqrt(standard.size)


def test_light_below_the_horizon_gives_black(make_bench: MakeBench) -> None:
    frame = make_bench(motion=resting_light(-85.0)).frames(1, TAG)[0]
    assert (frame.image == BLACK_DN).all()


def test_lamp_off_leaves_stray_light(make_bench: MakeBench) -> None:
    bench = make_bench(
        motion=resting_light(20.0, lamp=False), lamp=LampEffects(ambient_radiance=0.001)
    )
    frame = bench.frames(1, replace(TAG, lamp=False))[0]
    assert frame.image == pytest.approx(BLACK_DN + DN_PER_RADIANCE_MS * 4.0 * 0.001, rel=1e-6)


def test_codes_saturate(make_bench: MakeBench) -> None:
    frame = make_bench(exposure_ms=12.0).frames(1, TAG)[0]
    assert (frame.image[:28, :, 2] == 4095.0).all()
    assert (frame.image[:28, :, 0] < 4095.0).all()


@pytest.mark.parametrize("depth", [8, 10, 12, 14, 16])
def test_depth_scales_the_codes(make_bench: MakeBench, depth: int) -> None:
    quantised = CameraEffects(quantisation=True)
    frame = make_bench(quantised, sensor={"bit_depth": depth}).frames(1, TAG)[0]
    finest = make_bench().frames(1, TAG)[0]
    ratio = (2**depth - 1) / 4095.0
    assert frame.image.dtype == (np.uint8 if depth == 8 else np.uint16)
    assert np.abs(frame.image - ratio * finest.image).max() <= 0.501


def test_the_arm_hides_the_sample_from_the_top_camera_only(make_bench: MakeBench) -> None:
    """Hidden: the arm's 0.02 within 1.5 degrees of the vertical, whatever the sample."""
    for camera in (1, 2):
        bench = make_bench(motion=sweeping_light(-6.0, 15.0), camera=camera)
        for frame in bench.frames(24, TAG):
            angle_deg = -6.0 + 15.0 * (middle_ns(frame) - ZERO_NS) * 1e-9
            dark = frame.image.max() < 0.021 * DN_PER_RADIANCE_MS * 4.0 + BLACK_DN
            assert dark == (camera == 1 and abs(angle_deg) < 1.5), angle_deg
    bench = make_bench(motion=resting_light(0.0), camera=1, hidden_by_arm=False)
    assert bench.frames(1, TAG)[0].image.max() > 0.1 * DN_PER_RADIANCE_MS * 4.0


def test_motion_blur_averages_over_the_exposure(make_bench: MakeBench, folder: Path) -> None:
    """Against an average of 201 moments: Gauss with three is exact to fifth order in the angle."""
    sample = make_sample({"kind": "measured", "path": str(folder)})
    blurred = CameraEffects(motion_blur=True, saturation=False)
    bench = make_bench(blurred, sweeping_light(-30.0, 60.0), exposure_ms=32.0)
    for frame in bench.frames(10, TAG):
        moments_s = (middle_ns(frame) - ZERO_NS) * 1e-9 + 0.016 * np.linspace(-1, 1, 201)
        angles = -30.0 + 60.0 * moments_s
        radiance = np.trapezoid(sample.radiance(2, angles, 0.0, 1), axis=0) / 200.0
        expected = BLACK_DN + DN_PER_RADIANCE_MS * 32.0 * radiance
        assert frame.image[0, 0] == pytest.approx(expected, rel=1e-5)


def test_lamp_warms_up_and_drifts(make_bench: MakeBench) -> None:
    """Off for a second, then on: 1 - exp(-t/τ), times the drift since the beginning."""
    motion = SimMotion(
        until_ns=0,
        start_ns=(0, 1_000_000_000),
        angle_deg=(30.0, 30.0),
        speed_deg_s=(0.0, 0.0),
        acceleration_deg_s2=(0.0, 0.0),
        lamp=(False, True),
    )
    lamp = LampEffects(warm_up_s=2.0, drift_per_hour=3.6)
    full = make_bench().frames(1, TAG)[0].image[0, 0].astype(float) - BLACK_DN
    bench = make_bench(motion=motion, lamp=lamp)
    for frame in bench.frames(120, TAG):
        seconds = (middle_ns(frame) - ZERO_NS) * 1e-9
        bright = -np.expm1(-(seconds - 1.0) / 2.0) if seconds > 1.0 else 0.0
        expected = BLACK_DN + full * bright * (1.0 + 3.6 * seconds / 3600.0)
        assert frame.image[0, 0] == pytest.approx(expected, rel=1e-6)


def test_gain_errors_are_drawn_for_each_camera_and_channel(make_bench: MakeBench) -> None:
    """Also in the reference piece, by the same factors, whose spread is as told (chi-square)."""
    factors = []
    for seed in range(1, 41):
        effects = CameraEffects(gain_error_std=0.05, saturation=False)
        bench = make_bench(effects, camera=3, seed=seed)
        image = bench.frames(1, TAG)[0].image.astype(float) - BLACK_DN
        ideal = make_bench(camera=3).frames(1, TAG)[0].image.astype(float) - BLACK_DN
        factor = image / ideal
        assert np.ptp(factor.reshape(-1, 3), axis=0).max() < 1e-5
        factors.append(factor[0, 0])
    spread = np.std(np.array(factors) - 1.0)
    assert abs(spread / 0.05 - 1.0) < 3.89 / np.sqrt(2 * 120)


def test_flicker_is_common_to_a_frame(make_bench: MakeBench) -> None:
    effects = CameraEffects(relative_noise_std=0.01)
    frames = make_bench(effects).frames(400, TAG)
    ideal = make_bench().frames(1, TAG)[0].image.astype(float) - BLACK_DN
    factors = np.array([(frame.image - BLACK_DN) / ideal for frame in frames])
    assert np.ptp(factors.reshape(400, -1), axis=1).max() < 1e-5
    flicker = factors[:, 0, 0, 0] - 1.0
    assert abs(flicker.mean()) < 3.89 * 0.01 / np.sqrt(400)
    assert abs(flicker.std() / 0.01 - 1.0) < 3.89 / np.sqrt(800)


# -- region of interest


def test_region_cuts_out_of_the_sensor(make_bench: MakeBench) -> None:
    """Rows of the sensor keep what they show: the lowest eighth is the reference piece."""
    bench = make_bench()
    whole = bench.frames(1, TAG)[0].image
    for region in (Region(4, 8, 10, 24), Region(0, 0, 32, 6), Region(2, 29, 5, 3)):
        settings = CameraSettings(exposure_ms=4.0, frame_rate_hz=30.0, region=region)
        assert bench.driver.configure(settings).region == region
        image = bench.frames(1, TAG)[0].image
        x, y, width, height = region
        assert np.array_equal(image, whole[y : y + height, x : x + width])


@pytest.mark.parametrize("region", [(0, 0, 33, 32), (-1, 0, 8, 8), (0, 0, 0, 8), (30, 30, 4, 2)])
def test_region_beyond_the_sensor_is_refused(
    make_bench: MakeBench, region: tuple[int, int, int, int]
) -> None:
    bench = make_bench()
    settings = CameraSettings(exposure_ms=4.0, frame_rate_hz=30.0, region=Region(*region))
    with pytest.raises(DeviceError, match="does not lie on its sensor of 32x32"):
        bench.driver.configure(settings)
