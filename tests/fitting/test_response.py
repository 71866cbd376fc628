"""Camera response: codes to linear dn and back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tvbrdf_fitting.measurement.response import Response, largest_code

bit_depths = st.integers(8, 16)
increasing = st.lists(st.floats(0.01, 1.0), min_size=1, max_size=12)


@st.composite
def responses(draw: st.DrawFn) -> Response:
    kind = draw(st.sampled_from(["linear", "gamma", "table"]))
    if kind == "gamma":
        return Response("gamma", exponent=draw(st.floats(0.3, 3.0)))
    if kind == "table":
        linear = np.cumsum([0.0, *draw(increasing)])
        code = np.cumsum([0.0, *[draw(st.floats(0.01, 1.0)) for _ in linear[1:]]])
        return Response(
            "table", table_linear=tuple(linear / linear[-1]), table_code=tuple(code / code[-1])
        )
    return Response()


@given(response=responses(), bit_depth=bit_depths)
@settings(deadline=None)
def test_encode_undoes_linearise_for_every_code(response: Response, bit_depth: int) -> None:
    code = np.arange(largest_code(bit_depth) + 1)
    linear = response.linearise(code, bit_depth)
    # two roundings of float64 and a slope of at most 1e4 between them
    np.testing.assert_allclose(response.encode(linear, bit_depth), code, atol=1e-7 * code[-1])
    assert linear[0] == 0.0
    assert linear[-1] == pytest.approx(code[-1], rel=1e-12)
    assert np.array_equal(response.linear_table(bit_depth), linear)


@given(response=responses(), bit_depth=st.integers(8, 12))
@settings(deadline=None)
def test_linear_table_increases_and_slope_is_its_derivative(
    response: Response, bit_depth: int
) -> None:
    table = response.linear_table(bit_depth)
    assert np.all(np.diff(table) > 0.0)
    np.testing.assert_allclose(response.slope(table, bit_depth), np.gradient(table), rtol=1e-9)


def test_light_beyond_the_range_is_clipped() -> None:
    response = Response("gamma", exponent=0.4545)
    assert response.encode([-5.0, 1e9], 12).tolist() == [0.0, 4095.0]
    assert response.linearise([-3, 5000], 12).tolist() == [0.0, 4095.0]


def test_gamma_brightens_shadows_for_exponents_below_one() -> None:
    # the sRGB-like exponent: 18 % of the light gives about 46 % of the code
    code = Response("gamma", exponent=0.4545).encode(0.18 * 255, 8)
    assert code / 255 == pytest.approx(0.18**0.4545, rel=1e-12)


def test_measured_responses_can_be_undone(shared_data: Path) -> None:
    """The mean of 201 real camera responses (EMoR, Grossberg and Nayar)."""
    lines = (shared_data / "emor" / "emor.txt").read_text().split("\n")
    names = [i for i, line in enumerate(lines) if "=" in line]
    columns = {}
    for i, start in enumerate(names[:2]):
        text = " ".join(lines[start + 1 : names[i + 1]])
        columns[lines[start].split("=")[0].strip()] = np.array(text.split(), dtype=np.float64)
    response = Response("table", table_linear=tuple(columns["E"]), table_code=tuple(columns["f0"]))
    light = np.linspace(0.0, 4095.0, 997)
    np.testing.assert_allclose(response.linearise(response.encode(light, 12), 12), light, atol=1e-6)
    assert response.encode(0.18 * 4095, 12) > 0.3 * 4095


@pytest.mark.parametrize(
    ("linear", "code", "message"),
    [
        ((0.0, 0.6, 0.5, 1.0), (0.0, 0.3, 0.6, 1.0), "column linear: value 3 .0.5. is not above"),
        ((0.0, 0.5, 1.0), (0.0, 1.0, 1.0), "column code: value 3"),
        ((0.0, 1.0), (0.0, 0.5, 1.0), "as many of one as of the other"),
        ((0.0, 4095.0), (0.0, 1.0), "fractions of full scale"),
        ((0.1, 1.0), (0.0, 1.0), "fractions of full scale"),
    ],
)
def test_tables_that_cannot_be_undone_are_refused(
    linear: tuple[float, ...], code: tuple[float, ...], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        Response("table", table_linear=linear, table_code=code)


def test_other_parameters_are_checked() -> None:
    with pytest.raises(ValueError, match="exponent 0"):
        Response("gamma", exponent=0.0)
    with pytest.raises(ValueError, match="use linear, gamma or table"):
        Response("log")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="bit depth 7: give 8 to 16"):
        Response().linear_table(7)
    with pytest.raises(ValueError, match="too flat or steep"):
        Response(
            "table", table_linear=(0.0, 1.0 - 2.0**-52, 1.0), table_code=(0.0, 0.1, 1.0)
        ).linear_table(12)
