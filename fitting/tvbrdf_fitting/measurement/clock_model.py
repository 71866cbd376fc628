"""Clock models: from the stamps of a device's own clock to the run's clock.

A device's message carries the device's stamp and is received later: by a fixed latency and by a
jitter that is never negative (serial lines, USB, schedulers). So of many pairs the earliest
arrivals carry the information, and the clock's line is the lower envelope of the pairs. The fixed
latency cannot be seen in such pairs; whoever knows it subtracts it before. It is found from round
trips (`one_way_delay_ns`). What is left of it shifts the light against its motion: sweeps to and
fro have light offsets of opposite signs, which a fit with common errors finds and reports
(`inference.nuisances`); the latency is an offset over the light's speed.

Stamps are integer nanoseconds. UTC is about 1.8e18 ns, where float64 steps by 256 ns: origins are
subtracted as integers before any floating-point number is made.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry import FloatArray, IntArray
from .calibration import CameraCalibration

MIN_STAMPS = 8
MAX_DRIFT = 1e-3

# Of a line under n points with exponential delays of mean m, fitted as below: its error at u
# standard deviations of the stamps from their middle is 2 m/n in the mean (exact: the sum of the
# residuals has n - 2 degrees of freedom), and its standard deviation (m/n) sqrt(A + B u**2)
# (simulated for evenly spaced stamps; tests/fitting/test_clock_model.py repeats it).
_BIAS = 2.0
_VARIANCE_MIDDLE = 2.0
_VARIANCE_SLOPE = 4.6

# A run of stamps is late if its smallest delay is one that such a run has by chance once in 1e9
# fits. The shortest run looked at:
_SHORTEST_RUN = 12
_FALSE_ALARM = 1e-9
_ALIKE = 5.0


class ClockError(ValueError):
    """Stamps that no steady clock could have given; the message says what to look at."""


class ClockStepError(ClockError):
    """The device's or the computer's clock jumped within the stamps."""


@dataclass(frozen=True)
class ClockModel:
    """run = run_origin + (hardware - hardware_origin) * (1 + drift).

    Parameters
    ----------
    hardware_origin_ns, run_origin_ns : int
        The same moment on both clocks, near the middle of the stamps.
    drift : float
        By how much the run's clock goes faster than the device's.
    jitter_ns : float
        Scale of the one-sided jitter near its smallest values: the mean, if it is exponential.
    stamp_count : int
    spread_ns : float
        Standard deviation of the device's stamps about their middle.
    """

    hardware_origin_ns: int
    run_origin_ns: int
    drift: float
    jitter_ns: float
    stamp_count: int
    spread_ns: float

    @property
    def offset_ns(self) -> int:
        """Run's clock minus device's clock at the origin."""
        return self.run_origin_ns - self.hardware_origin_ns

    def to_run_ns(self, hardware_ns: ArrayLike) -> IntArray:
        """Run's clock (int64, any shape) at stamps of the device's clock (int64)."""
        elapsed = np.asarray(hardware_ns, dtype=np.int64) - self.hardware_origin_ns
        correction = np.rint(elapsed * self.drift).astype(np.int64)
        return np.asarray(self.run_origin_ns + elapsed + correction, dtype=np.int64)

    def std_ns(self, hardware_ns: ArrayLike) -> FloatArray:
        """Standard deviation of `to_run_ns` at the given device stamps, in ns.

        It holds for jitter whose density does not vanish at its smallest value; then the error
        falls as 1/n, with tails that are exponential rather than Gaussian. It does not know errors
        of the latency that was subtracted.
        """
        elapsed = np.asarray(hardware_ns, dtype=np.int64) - self.hardware_origin_ns
        turned = np.asarray(elapsed, dtype=np.float64) / self.spread_ns
        scale = self.jitter_ns / self.stamp_count
        return np.asarray(scale * np.sqrt(_VARIANCE_MIDDLE + _VARIANCE_SLOPE * turned**2))


@dataclass(frozen=True, eq=False)
class FrameStamps:
    """When frames were taken on the run's clock, middle of exposure: (n,) ns, and its std."""

    stamp_ns: IntArray
    std_ns: FloatArray
    clock: ClockModel


@dataclass(frozen=True)
class OneWayDelay:
    """Latency of the way from the device to the computer, and what it was taken from.

    ``offset_ns`` is the run's clock minus the device's at the fastest round trip, in ns.
    """

    delay_ns: float
    std_ns: float
    round_trip_ns: int
    offset_ns: int


def fit_clock(
    hardware_ns: ArrayLike, received_ns: ArrayLike, *, resolution_ns: float = 1e3
) -> ClockModel:
    """Clock model from device stamps and arrival times: the line under all pairs.

    Of all lines that no pair lies below, the one with the smallest sum of distances, which is the
    most likely one for exponential jitter. It is the edge of the lower convex hull over the mean
    stamp, so late outliers, be they ever so late or many in a row, do not move it.

    Parameters
    ----------
    hardware_ns, received_ns : array_like of int64, shape (n,)
        Device's stamp, and arrival on the run's clock less the known latency. Any order; a
        repeated device stamp counts once, with its first arrival.
    resolution_ns : float
        Tick of the coarser clock. Steps up to two ticks are the clock's normal way to go.

    Raises
    ------
    ClockStepError
        If either clock stepped: the pairs before and after fit one rate but not one offset. A
        stamp that came too early is reported so too. (A step in the first or last dozen stamps,
        or one smaller than the jitter can hide, cannot be told from jitter.)
    ClockError
        With fewer than 8 different stamps, or a rate more than 0.1 % off.
    """
    hardware, received = _sorted_pairs(hardware_ns, received_ns)
    hardware_origin = int(hardware[0]) + int(np.rint(np.mean(hardware - hardware[0])))
    base = int(received[0] - hardware[0])
    x = (hardware - hardware_origin).astype(np.float64)
    y = (received - hardware - base).astype(np.float64)
    intercept, slope = _line_below(x, y)
    residual = y - intercept - slope * x
    _refuse_step(x, y, residual, resolution_ns)
    if abs(slope) > MAX_DRIFT:
        raise ClockError(
            f"device clock runs {slope * 1e6:.0f} ppm off the run's clock over "
            f"{np.ptp(x) / 1e9:.3g} s; at most {MAX_DRIFT * 1e6:.0f} ppm is believed: check the "
            "unit of its stamps"
        )
    jitter = _jitter_scale(residual)
    correction = intercept - _BIAS * jitter / x.size
    return ClockModel(
        hardware_origin_ns=hardware_origin,
        run_origin_ns=hardware_origin + base + round(correction),
        drift=slope,
        jitter_ns=jitter,
        stamp_count=int(x.size),
        spread_ns=float(np.std(x)),
    )


def frame_stamps(
    hardware_ns: ArrayLike,
    received_ns: ArrayLike,
    exposure_ms: ArrayLike,
    camera: CameraCalibration,
) -> FrameStamps:
    """Middle of exposure on the run's clock of a camera's frames, all of them used at once.

    Uses received = middle + exposure/2 + frame_delay + jitter (see `.calibration`).

    Parameters
    ----------
    hardware_ns, received_ns : array_like of int64, shape (n,)
    exposure_ms : array_like, scalar or (n,)
        As read back from the camera.
    """
    half_ns = np.rint(np.asarray(exposure_ms, dtype=np.float64) * 5e5).astype(np.int64)
    before_middle = {"exposure_start": -1, "exposure_middle": 0, "exposure_end": 1}
    sign = before_middle[camera.hardware_stamp_event]
    middle = np.asarray(hardware_ns, dtype=np.int64) - sign * half_ns
    delay_ns = round(camera.frame_delay_ms * 1e6)
    try:
        clock = fit_clock(middle, np.asarray(received_ns, dtype=np.int64) - half_ns - delay_ns)
    except ClockError as error:
        raise type(error)(f"camera {camera.camera}: {error}") from error
    return FrameStamps(
        stamp_ns=clock.to_run_ns(middle),
        std_ns=np.hypot(clock.std_ns(middle), camera.frame_delay_std_ms * 1e6),
        clock=clock,
    )


def one_way_delay_ns(
    sent_ns: ArrayLike, hardware_ns: ArrayLike, received_ns: ArrayLike
) -> OneWayDelay:
    """Latency from a device to the computer, from the fastest of many round trips.

    The device stamps a question when it comes in and answers at once. Both ways of the fastest
    round trip together last ``round_trip_ns``; how they share it is unknown, so each is taken as
    half of it, with the standard deviation of a number that is uniform in [0, round trip].

    Parameters
    ----------
    sent_ns, hardware_ns, received_ns : array_like of int64, shape (n,)
        Question sent (run's clock), stamped (device's clock), answer received (run's clock).

    Raises
    ------
    ClockError
        Without round trips, or if an answer came before its question.
    """
    sent = np.atleast_1d(np.asarray(sent_ns, dtype=np.int64))
    hardware = np.atleast_1d(np.asarray(hardware_ns, dtype=np.int64))
    received = np.atleast_1d(np.asarray(received_ns, dtype=np.int64))
    if not sent.shape == hardware.shape == received.shape or sent.ndim != 1 or sent.size == 0:
        raise ClockError(
            f"round trips: {sent.size} sent, {hardware.size} stamped, {received.size} received; "
            "give the same number of each, at least one"
        )
    round_trip = received - sent
    fastest = int(np.argmin(round_trip))
    shortest = int(round_trip[fastest])
    if shortest < 0:
        raise ClockError(
            f"round trip {fastest}: answered {-shortest} ns before it was asked; "
            "pair each answer with its own question, both on the run's clock"
        )
    return OneWayDelay(
        delay_ns=shortest / 2.0,
        std_ns=shortest / math.sqrt(12.0),
        round_trip_ns=shortest,
        offset_ns=int(sent[fastest]) + shortest // 2 - int(hardware[fastest]),
    )


def _sorted_pairs(hardware_ns: ArrayLike, received_ns: ArrayLike) -> tuple[IntArray, IntArray]:
    hardware = np.asarray(hardware_ns)
    received = np.asarray(received_ns)
    for name, stamps in (("hardware", hardware), ("received", received)):
        if stamps.ndim != 1 or not np.issubdtype(stamps.dtype, np.integer):
            raise ClockError(
                f"{name} stamps are {stamps.dtype} of shape {stamps.shape}; give a row of integer "
                "nanoseconds (float64 cannot hold UTC to the nanosecond)"
            )
    if hardware.size != received.size:
        raise ClockError(f"{hardware.size} hardware stamps for {received.size} received ones")
    order = np.lexsort((received, hardware))
    hardware = hardware[order].astype(np.int64)
    received = received[order].astype(np.int64)
    first = np.ones(hardware.size, dtype=np.bool_)
    first[1:] = hardware[1:] != hardware[:-1]
    hardware, received = hardware[first], received[first]
    if hardware.size < MIN_STAMPS:
        raise ClockError(
            f"{hardware.size} different stamps are too few for a clock model; it needs {MIN_STAMPS}"
        )
    # by arrival: a device clock that steps back would else mix its stamps from before and after
    order = np.lexsort((hardware, received))
    return hardware[order], received[order]


def _line_below(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Intercept and slope of the edge of the lower hull over x = 0, which is the mean of x."""
    hull = _lower_hull(x, y)
    hx, hy = x[hull], y[hull]
    right = min(max(int(np.searchsorted(hx, 0.0)), 1), hx.size - 1)
    slope = float((hy[right] - hy[right - 1]) / (hx[right] - hx[right - 1]))
    return float(hy[right] - slope * hx[right]), slope


def _lower_hull(x: FloatArray, y: FloatArray) -> NDArray[np.intp]:
    """Indices of the lower convex hull's corners, x rising (Andrew's monotone chain)."""
    order = np.argsort(x, kind="stable")
    xs, ys = x[order].tolist(), y[order].tolist()
    hull: list[int] = []
    for i in range(len(xs)):
        while len(hull) >= 2:
            a, b = hull[-2], hull[-1]
            if (ys[b] - ys[a]) * (xs[i] - xs[a]) < (ys[i] - ys[a]) * (xs[b] - xs[a]):
                break
            hull.pop()
        hull.append(i)
    return order[hull]


def _jitter_scale(residual: FloatArray) -> float:
    """Mean of the exponential that the small residuals look like; late outliers do not count."""
    quarter = _exponential_scale(residual, 0.25)
    sixteenth = _exponential_scale(residual, 1.0 / 16.0)
    # where clearly fewer delays are near the smallest than an exponential has, believe those
    return sixteenth if sixteenth > 2.0 * quarter else quarter


def _exponential_scale(residual: FloatArray, share: float) -> float:
    return max(float(np.quantile(residual, share)) / -math.log1p(-share), 1.0)


def _late(residual: FloatArray, resolution_ns: float) -> NDArray[np.bool_]:
    """Mask (n,), in order of arrival, of stamps in runs that all came later than by chance."""
    late = np.zeros(residual.size, dtype=np.bool_)
    scale = max(_exponential_scale(residual, 0.25), resolution_ns)
    length = _SHORTEST_RUN
    while length <= residual.size // 2:
        count = residual.size // length
        smallest = residual[: count * length].reshape(count, length).min(axis=1)
        # the smallest of k exponential delays is above t with probability exp(-k t / scale)
        limit = scale * math.log(count / _FALSE_ALARM) / length
        late[: count * length] |= np.repeat(smallest > limit, length)
        length *= 2
    return late


def _refuse_step(x: FloatArray, y: FloatArray, residual: FloatArray, resolution_ns: float) -> None:
    """Raise if runs of late stamps vanish once the clock may step; a late burst stays late."""
    late = int(np.count_nonzero(_late(residual, resolution_ns)))
    if late == 0:
        return
    stride = max(1, x.size // 128)
    starts = range(_SHORTEST_RUN, x.size - _SHORTEST_RUN + 1, stride)
    fits = [_stepped_lines(x, y, start) for start in starts]
    best = int(np.argmin([np.sum(residuals) for _, residuals in fits]))
    step, stepped_residual = fits[best]
    still_late = int(np.count_nonzero(_late(stepped_residual, resolution_ns)))
    # after a step the jitter is what it was; stamps that were each late for their own time are not
    # so alike (the last arrivals of all tend to be such)
    before = float(np.median(stepped_residual[: starts[best]])) + resolution_ns
    after = float(np.median(stepped_residual[starts[best] :])) + resolution_ns
    alike = max(before, after) < _ALIKE * min(before, after)
    if alike and 2 * still_late < late and abs(step) > 2.0 * resolution_ns:
        raise ClockStepError(
            f"clock stepped by {abs(step) / 1e6:.3f} ms near stamp {starts[best]} of {x.size}: "
            f"arrivals after it are {'later' if step > 0 else 'earlier'} than one steady clock "
            "allows; repeat the sweep, and see that nothing sets either clock meanwhile"
        )


def _stepped_lines(x: FloatArray, y: FloatArray, start: int) -> tuple[float, FloatArray]:
    """Step, and residuals of two lines of one slope under the stamps before and from `start`.

    Stamps are in order of arrival.
    """
    left, right = _lower_hull(x[:start], y[:start]), _lower_hull(x[start:], y[start:])
    x_left, y_left = x[left], y[left]
    x_right, y_right = x[start:][right], y[start:][right]
    slopes = np.concatenate(
        [np.diff(y_left) / np.diff(x_left), np.diff(y_right) / np.diff(x_right)]
    )
    # the sum of distances is piecewise linear in the slope: its minimum is at an edge's slope
    slopes = np.clip(slopes, -MAX_DRIFT, MAX_DRIFT)
    lowest_left = np.min(y_left[:, None] - x_left[:, None] * slopes, axis=0)
    lowest_right = np.min(y_right[:, None] - x_right[:, None] * slopes, axis=0)
    total = start * lowest_left + (x.size - start) * lowest_right + slopes * np.sum(x)
    best = int(np.argmax(total))
    residual = y - slopes[best] * x
    residual[:start] -= lowest_left[best]
    residual[start:] -= lowest_right[best]
    return float(lowest_right[best] - lowest_left[best]), residual
