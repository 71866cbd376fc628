"""From published text to what a fit takes: the noise it has, and what is suspicious in it."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tvbrdf_fitting import fit_scan
from tvbrdf_fitting.geometry import (
    CAMERA_ANGLES_DEG,
    FloatArray,
    above_horizon,
    light_direction,
    view_direction,
)
from tvbrdf_fitting.models import SURFACE, get_model
from tvbrdf_fitting.published import (
    CameraScan,
    PublishedFormatError,
    PublishedScan,
    read_scan,
    scan_file_name,
    write_scan_file,
)
from tvbrdf_fitting.published.checks import (
    check_cameras,
    check_files,
    check_name,
    check_parameters,
    check_scan,
    check_series,
    diffuse_colour,
    order_of,
)
from tvbrdf_fitting.published.compiled import add_differences, running_mean
from tvbrdf_fitting.published.observations import ROUNDING, SMALLEST_RELATIVE

EXPOSURES_MS = (0.2, 4.0, 32.0)
TRUTH = (0.08, 0.2, 0.45, 0.3, 0.6, 9.0)
"""A red paint with a highlight: kd B, G, R, sigma_d, ks, 1/sigma_s."""


def deviation_of(radiance: NDArray[np.float64], noise: float) -> NDArray[np.float64]:
    """Shot noise over read noise, as a camera has it."""
    return noise * np.sqrt(0.02 + radiance)


def published(
    noise: float = 0.005,
    *,
    truth: tuple[float, ...] = TRUTH,
    step: int = 1,
    seed: int = 1,
) -> PublishedScan:
    """A scan of the rig: every half degree, with the gap that the arm leaves in camera 1."""
    rng = np.random.default_rng(seed)
    world = np.linspace(-90.0, 90.0, 361)[::step]
    cameras = {}
    for camera, angle in enumerate(CAMERA_ANGLES_DEG, start=1):
        light = light_direction(world)
        keep = above_horizon(light) & ((camera > 1) | (np.abs(world) > 1.6))
        light = light[keep]
        view = np.broadcast_to(view_direction(angle), light.shape)
        clean = np.pi * light[:, 2:] * get_model(SURFACE).evaluate(light, view, truth)
        measured = clean + deviation_of(clean, noise) * rng.standard_normal(clean.shape)
        cameras[camera] = CameraScan(EXPOSURES_MS, light, view[0].copy(), measured)
    return PublishedScan(1, EXPOSURES_MS, cameras)


def reordered(camera: CameraScan, order: tuple[int, ...]) -> CameraScan:
    return replace(camera, radiance=camera.radiance[:, list(order)])


def with_cameras(scan: PublishedScan, **changed: CameraScan) -> PublishedScan:
    given = {int(name[-1]): camera for name, camera in changed.items()}
    return replace(scan, cameras=scan.cameras | given)


@pytest.mark.parametrize("noise", [2e-3, 1e-2, 5e-2])
def test_noise_is_found_from_neighbouring_lights(noise: float) -> None:
    scan = published(noise)
    clean = published(0.0)
    found = np.sqrt(scan.observations().variance)
    true = deviation_of(np.concatenate([c.radiance for c in clean.cameras.values()]), noise)
    ratio = found / true
    # a bin's median of 100 squares scatters by 17 % (8 % of a deviation); three terms smooth that
    assert 0.85 < np.median(ratio) < 1.15
    assert np.mean((ratio > 0.7) & (ratio < 1.4)) > 0.95


def test_differences_are_what_no_parabola_explains() -> None:
    """Of four values, the part along the one unit vector that is normal to all parabolas."""
    rng = np.random.default_rng(3)
    angle = np.cumsum(rng.uniform(0.5, 1.5, 12))
    angle[7:] += 10.0  # a gap: no difference reaches across
    values = rng.standard_normal((12, 3))
    square, level = np.full((3, 12), -1.0), np.full((3, 12), -1.0)
    count = add_differences(angle, values, 5.0, square, level, 2)
    starts = [0, 1, 2, 3, 7, 8]
    assert count == 2 + len(starts)
    for place, start in enumerate(starts, start=2):
        four = slice(start, start + 4)
        normal = np.linalg.svd(np.vander(angle[four], 3).T)[2][-1]
        np.testing.assert_allclose(square[:, place], (normal @ values[four]) ** 2, rtol=1e-9)
        np.testing.assert_allclose(level[:, place], values[four].mean(axis=0), rtol=1e-12)
    assert (square[:, [0, 1, *range(count, 12)]] == -1.0).all()


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 9])
def test_a_running_mean_takes_fewer_values_at_the_ends(count: int) -> None:
    values = np.random.default_rng(count).standard_normal((count, 3))
    kernel = np.ones(min(5, count))
    number = np.convolve(np.ones(count), kernel, mode="same")
    expected = [np.convolve(channel, kernel, mode="same") / number for channel in values.T]
    np.testing.assert_array_equal(running_mean(values, 5), np.transpose(expected))


def test_a_peak_is_not_taken_for_noise() -> None:
    """A lobe of 3 steps' width: third differences there are 100 times the noise."""
    sharp = (*TRUTH[:4], 20.0, 1 / 0.03)
    scan, clean = published(0.002, truth=sharp), published(0.0, truth=sharp)
    true = deviation_of(clean.cameras[1].radiance, 0.002)
    found = np.sqrt(scan.observations().variance[: len(true)])
    at_peak = clean.cameras[1].radiance > 0.5 * clean.cameras[1].radiance.max(axis=0)
    assert at_peak.any()
    # beyond the bulk of the values, the noise is extrapolated as shot noise
    assert (found[at_peak] < 2.5 * true[at_peak]).all()


def test_no_value_is_taken_for_more_precise_than_a_rig_is() -> None:
    observations = published(0.0).observations()
    smooth = np.maximum(observations.radiance, np.median(observations.radiance, axis=0))
    share = np.sqrt(observations.variance) / smooth
    # the mean over five lights at a peak is a few per cent below it
    assert share.min() > 0.9 * SMALLEST_RELATIVE
    dark = replace(
        published(0.0),
        cameras={
            n: replace(c, radiance=np.zeros_like(c.radiance))
            for n, c in published(0.0).cameras.items()
        },
    )
    np.testing.assert_allclose(np.sqrt(dark.observations().variance), ROUNDING, rtol=1e-12)


def test_parameters_of_a_published_scan_are_the_true_ones() -> None:
    pulls = []
    for seed in range(6):
        fit = fit_scan(published(0.005, seed=seed).observations())
        assert fit.undetermined == ()
        assert 0.7 < fit.chi_square / fit.degrees_of_freedom < 1.4
        pulls.append((fit.values - TRUTH) / fit.standard_deviations)
    # 36 standard normal values, with deviations known to about a tenth: beyond 4.5 one in 10 000
    assert np.abs(pulls).max() < 4.5
    assert 0.5 < np.std(pulls) < 1.6


def test_calibration_divides() -> None:
    scan = published(0.005)
    constants = np.linspace(0.5, 2.0, 12).reshape(4, 3)
    raw = replace(
        scan,
        cameras={
            n: replace(c, radiance=c.radiance * constants[n - 1]) for n, c in scan.cameras.items()
        },
    )
    one, other = scan.observations(), raw.observations(constants)
    np.testing.assert_allclose(other.radiance, one.radiance, rtol=1e-12)
    for bad in (np.ones((4, 2)), np.zeros((4, 3)), np.full((4, 3), np.nan)):
        with pytest.raises(ValueError, match=r"constants must be \(4, 3\), finite and positive"):
            scan.observations(bad)


def test_too_few_lights_to_tell_the_noise() -> None:
    scan = published(0.005, step=120)
    observations = scan.observations()
    assert len(observations) < 16
    level = np.maximum(observations.radiance, 0.0)
    assert (np.sqrt(observations.variance) <= 0.011 * level.max()).all()
    assert any("too few light positions" in text for text in check_scan(scan))


def test_a_scan_is_found_by_its_file_or_its_folder(tmp_path: Path) -> None:
    data = tmp_path / "sample01" / "tvBrdf-data"
    data.mkdir(parents=True)
    scan = published()
    for number, camera in scan.cameras.items():
        write_scan_file(data / scan_file_name(4, number), camera)
    asked: tuple[tuple[Path, int | None], ...] = (
        (data / scan_file_name(4, 2), None),
        (data.parent, None),
        (data.parent, 4),
    )
    for path, number_asked in asked:
        found = read_scan(path, number_asked)
        assert found.scan == 4
        assert sorted(found.cameras) == [1, 2, 3, 4]
    with pytest.raises(PublishedFormatError, match="is a file of scan 4, not of 5"):
        read_scan(data / scan_file_name(4, 2), 5)
    with pytest.raises(PublishedFormatError, match="no such file"):
        read_scan(data / scan_file_name(5, 2))
    write_scan_file(data / scan_file_name(5, 1), scan.cameras[1])
    with pytest.raises(PublishedFormatError, match="has 2 scans: say which"):
        read_scan(data.parent)


def test_a_link_to_nothing_is_no_missing_camera(tmp_path: Path) -> None:
    data = tmp_path / "tvBrdf-data"
    data.mkdir()
    write_scan_file(data / scan_file_name(1, 1), published().cameras[1])
    (data / scan_file_name(1, 2)).symlink_to(tmp_path / "nowhere")
    with pytest.raises(PublishedFormatError, match=r"camera2.*no such file"):
        read_scan(tmp_path, 1)


# -- remarks


def test_a_good_scan_gets_no_remark() -> None:
    scan = published()
    assert check_scan(scan) == ()
    assert check_cameras(scan.observations()) == ()


def test_real_materials_get_no_remark(shared_data: Path) -> None:
    for folder in sorted((shared_data / "rgl_on_rig").iterdir()):
        scan = read_scan(folder)
        observations = scan.observations()
        assert check_files(folder) + check_scan(scan) + check_cameras(observations) == ()
        assert check_name(folder.name, diffuse_colour(observations)) == ()
    iron = shared_data / "staf_cast_iron"
    colours = {n: diffuse_colour(read_scan(iron, n).observations()) for n in range(1, 29)}
    assert check_series(colours) == ()


@pytest.mark.parametrize(("camera", "end"), [(1, "after"), (3, "before")])
def test_a_file_cut_between_groups_stands_out(camera: int, end: str) -> None:
    scan = published()
    whole = scan.cameras[camera]
    kept = slice(0, -40) if end == "after" else slice(40, None)
    cut = replace(whole, light_direction=whole.light_direction[kept], radiance=whole.radiance[kept])
    (remark,) = check_scan(with_cameras(scan, **{f"camera{camera}": cut}))
    assert f"camera {camera} has no light positions {end}" in remark
    assert "the other cameras have 40 or more" in remark


def test_doubled_and_missing_files_stand_out() -> None:
    scan = published()
    two = scan.cameras[2]
    doubled = replace(
        two,
        light_direction=np.tile(two.light_direction, (2, 1)),
        radiance=np.tile(two.radiance, (2, 1)),
    )
    assert check_scan(with_cameras(scan, camera2=doubled)) == (
        f"camera 2 has {len(two.radiance)} light positions twice",
    )
    assert any(
        "cameras 2 and 3 have the same view" in text
        for text in check_scan(with_cameras(scan, camera3=two))
    )
    few = replace(scan, cameras={n: scan.cameras[n] for n in (1, 4)})
    assert check_scan(few) == ("there is no file of cameras 2, 3",)


def test_a_dead_channel_stands_out() -> None:
    scan = published()
    radiance = scan.cameras[3].radiance.copy()
    radiance[:, 1] = 0.0
    dead = replace(scan.cameras[3], radiance=radiance)
    assert check_cameras(with_cameras(scan, camera3=dead).observations()) == (
        "camera 3 has no radiance above 0 in channel g: is it dead?",
    )


def test_files_that_are_not_read_are_named(tmp_path: Path) -> None:
    data = tmp_path / "tvBrdf-data"
    data.mkdir()
    for number in (1, 2, 5):
        write_scan_file(data / scan_file_name(number, 1), published(step=8).cameras[1])
    assert check_files(tmp_path) == ("there are no files of scans 3, 4",)
    assert check_files(tmp_path, missing=(3,)) == ("there are no files of scan 4",)
    (data / "scan3_brdf_camera1_allexposures.txt").write_text("")
    (data / "scan04_brdf_camera7_allexposures.txt").write_text("")
    remark, _ = check_files(tmp_path)
    assert remark.startswith("scan04_brdf_camera7_allexposures.txt and 1 more in tvBrdf-data is")


ORDERS = [order for order in permutations(range(3)) if order != (0, 1, 2)]


@pytest.mark.parametrize("order", ORDERS)
def test_a_camera_with_another_order_of_colours_stands_out(order: tuple[int, ...]) -> None:
    scan = published()
    wrong = with_cameras(scan, camera2=reordered(scan.cameras[2], order))
    (remark,) = check_cameras(wrong.observations())
    names = ", ".join("BGR"[channel] for channel in order)
    assert remark.startswith(f"camera 2 agrees with the others if its channels are {names}:")


def test_a_grey_sample_has_no_order_of_colours() -> None:
    scan = published(truth=(0.4, 0.42, 0.44, 0.2, 0.5, 8.0))
    wrong = with_cameras(scan, camera2=reordered(scan.cameras[2], (2, 1, 0)))
    assert check_cameras(wrong.observations()) == ()


def test_scans_with_another_order_of_colours_stand_out() -> None:
    """A paint that dries from red to brown: its slow change is no other order."""
    colours: dict[int, FloatArray] = {}
    for number in range(1, 9):
        kd = (0.08 + 0.01 * number, 0.2, 0.45 - 0.03 * number)
        colours[number] = diffuse_colour(published(truth=(*kd, 0.3, 0.3, 9.0)).observations())
    assert check_series(colours) == ()
    swapped = colours | {n: colours[n][::-1] for n in (4, 5)}
    (remark,) = check_series(swapped)
    assert remark.startswith("scans 4, 5: colours are those of the scan before if the channels")
    assert "are R, G, B" in remark


def test_parameters_and_names_that_contradict_the_colours() -> None:
    colour = diffuse_colour(published().observations())
    assert check_parameters(colour, TRUTH[:3]) == ()
    assert check_parameters(colour, (0.4, 0.4, 0.4)) == ()
    assert "are R, G, B" in check_parameters(colour, TRUTH[2::-1])[0]
    assert check_parameters(colour, (0.0, 0.2, 0.4)) == ()
    assert check_name("red_paint", colour) == ()
    assert check_name("bored", colour) == ()
    (remark,) = check_name("Blue paint 2", colour)
    assert "says blue, but red is" in remark


def test_a_colour_that_no_order_explains_is_left_alone() -> None:
    colour = np.array([1.0, -0.2, -0.8])
    assert order_of(colour, np.array([-0.1, 0.2, -0.1])) == ""
    assert order_of(np.full(3, np.nan), colour) == ""
