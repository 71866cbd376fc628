"""What is suspicious in a published sample although every file keeps to the layout.

Remarks for people, no errors: each has an innocent explanation too.

*Cut between two groups.* A file that ends there is whole by its layout. But all cameras of a scan
see the same light positions, so one that lacks many at an end which the others have stands out.

*Order of the colours.* F is B, G, R; no line says so. It shows where two sources disagree in such
a way that another order of the channels brings them together: one camera against the others of its
scan, one scan against those around it, the radiances against the diffuse colour in
``brdf-params.txt``, or against a colour in the sample's name. It cannot be seen where all files of
a sample have the same wrong order and neither fits nor a name speak against it, in grey samples,
and in calibration constants: a camera's three constants may have any ratio.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from itertools import permutations
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from ..geometry import CHANNELS, FloatArray
from ..observations import Observations
from .observations import ASSUMED_RELATIVE, FEWEST_DIFFERENCES
from .scan import (
    CAMERAS,
    DATA_FOLDER,
    PublishedScan,
    parse_scan_file_name,
)
from .scan_file import CameraScan

MISSING_AT_AN_END: Final = 5
"""Light positions that the other cameras have beyond a file's end, to be told."""
COLOUR: Final = 0.15
"""Difference of the logarithm of two channels below which a colour is too grey to tell."""
ALIKE: Final = 0.3
"""Share of the distance between two colours that must be left by another order, at the most."""
_STRAIGHT = (0, 1, 2)
_SAME_DIRECTION: Final = 1e-3
_NAMED_COLOURS: Final = {
    "blue": (0, 2),
    "navy": (0, 2),
    "red": (2, 0),
    "orange": (2, 0),
    "yellow": (2, 0),
    "golden": (2, 0),
    "brown": (2, 0),
    "rusty": (2, 0),
}
"""Words of a name, with the channel that must not be darker than the other one."""


def check_files(folder: Path | str, missing: Collection[int] = ()) -> tuple[str, ...]:
    """Remarks on what ``tvBrdf-data`` lacks (but scans known as missing), or holds in vain."""
    names = sorted(path.name for path in (Path(folder) / DATA_FOLDER).iterdir())
    read = [parsed for parsed in map(parse_scan_file_name, names) if parsed is not None]
    ignored = [n for n in names if n.startswith("scan") and parse_scan_file_name(n) is None]
    remarks = []
    if ignored:
        more = f" and {len(ignored) - 1} more" if len(ignored) > 1 else ""
        remarks.append(
            f"{ignored[0]}{more} in {DATA_FOLDER} is not read: scan files are named "
            "scanTT_brdf_cameraV_allexposures.txt, TT from 01, V from 1 to 4"
        )
    numbers = {scan for scan, _ in read}
    lost = sorted(set(range(1, max(numbers, default=0))) - numbers - {*missing})
    if lost:
        remarks.append(f"there are no files of {_listed('scan', lost)}")
    return tuple(remarks)


def check_scan(scan: PublishedScan) -> tuple[str, ...]:
    """Remarks on a scan's cameras: which, their light positions and views."""
    cameras = scan.cameras
    angles = {number: _angle_deg(one) for number, one in cameras.items()}
    lost = [number for number in CAMERAS if number not in cameras]
    remarks = [f"there is no file of {_listed('camera', lost)}"] if lost else []
    for number, own in angles.items():
        others = [angles[other] for other in angles if other != number]
        remarks += _ends(number, own, others)
        doubled = len(own) - len(np.unique(own))
        if doubled:
            remarks.append(f"camera {number} has {doubled} light positions twice")
    numbers = list(cameras)
    for index, number in enumerate(numbers):
        for other in numbers[:index]:
            views = cameras[number].view_direction, cameras[other].view_direction
            if np.abs(views[0] - views[1]).max() < _SAME_DIRECTION:
                remarks.append(
                    f"cameras {other} and {number} have the same view direction: "
                    "is one file a copy of the other?"
                )
    if sum(max(len(own) - 3, 0) for own in angles.values()) < FEWEST_DIFFERENCES:
        remarks.append(
            "there are too few light positions to estimate the noise from: "
            f"{100 * ASSUMED_RELATIVE:g} % is assumed"
        )
    return tuple(remarks)


def _angle_deg(camera: CameraScan) -> FloatArray:
    light = camera.light_direction
    return np.asarray(np.round(np.degrees(np.arctan2(light[:, 0], light[:, 2])), 4), np.float64)


def _listed(what: str, numbers: Sequence[object]) -> str:
    return f"{what}{'s' if len(numbers) > 1 else ''} {', '.join(map(str, numbers))}"


def _ends(number: int, own: FloatArray, others: Sequence[FloatArray]) -> list[str]:
    """Remark on light positions at an end of the sweep that every other camera has."""
    if len(others) < 2:
        return []
    remarks = []
    for end, beyond in (
        ("after", min(np.count_nonzero(other > own.max()) for other in others)),
        ("before", min(np.count_nonzero(other < own.min()) for other in others)),
    ):
        if beyond >= MISSING_AT_AN_END:
            edge = own.max() if end == "after" else own.min()
            remarks.append(
                f"camera {number} has no light positions {end} {edge:.1f}°, the other cameras "
                f"have {beyond} or more: was its file cut off between two of them?"
            )
    return remarks


def diffuse_colour(observations: Observations, camera: int | None = None) -> FloatArray:
    """Logarithm of the channels' radiance (3,) less its mean: the colour, by medians over lights.

    NaN where a channel is mostly dark. A highlight covers few light positions, which a median
    passes over.
    """
    used = observations.usable.all(axis=1)
    if camera is not None:
        used &= observations.camera == camera
    radiance = observations.radiance[used]
    noise = np.sqrt(observations.variance[used])
    seen = (radiance > 3 * noise).all(axis=1)
    if np.count_nonzero(seen) <= 0.5 * np.count_nonzero(used):
        return np.full(3, np.nan)
    return centred(np.median(np.log(radiance[seen]), axis=0))


def centred(log_values: ArrayLike) -> FloatArray:
    """Logarithms less their mean: what brightness does not change."""
    values = np.asarray(log_values, dtype=np.float64)
    return np.asarray(values - values.mean())


def order_of(colour: FloatArray, reference: FloatArray) -> str:
    """Return the order that a colour's channels seem to have if the reference's is B, G, R.

    Empty where B, G, R fits, or no other order fits clearly better.
    """
    straight = float(np.linalg.norm(colour - reference))
    if not straight > COLOUR:  # alike, or not known
        return ""
    distance = {
        order: float(np.linalg.norm(colour[[*order]] - reference))
        for order in permutations(_STRAIGHT)
    }
    best = min(distance, key=lambda order: distance[order])
    if best == _STRAIGHT or distance[best] > ALIKE * straight:
        return ""
    places = {best[channel]: CHANNELS[channel].upper() for channel in _STRAIGHT}
    return ", ".join(places[place] for place in _STRAIGHT)


def check_cameras(observations: Observations) -> tuple[str, ...]:
    """Remarks on dead channels, and on a camera whose colours are the others' in another order."""
    numbers = np.unique(observations.camera).tolist()
    dead = [text for number in numbers for text in _dead(observations, number)]
    colours = {n: diffuse_colour(observations, n) for n in numbers}
    known = {n: colour for n, colour in colours.items() if np.isfinite(colour).all()}
    remarks = dead
    for number, colour in known.items():
        others = [known[other] for other in known if other != number]
        if len(others) < 2:
            continue
        order = order_of(colour, np.median(others, axis=0))
        if order:
            remarks.append(
                f"camera {number} agrees with the others if its channels are {order}: its file "
                "seems to have another order than B, G, R"
            )
    return tuple(remarks)


def _dead(observations: Observations, camera: int) -> list[str]:
    rows = observations.camera == camera
    usable = observations.usable[rows]
    bright = usable & (np.where(usable, observations.radiance[rows], 0.0) > 0)
    names = [CHANNELS[k] for k in range(3) if usable[:, k].any() and not bright[:, k].any()]
    if not names:
        return []
    return [f"camera {camera} has no radiance above 0 in {_listed('channel', names)}: is it dead?"]


def check_series(colours: Mapping[int, FloatArray]) -> tuple[str, ...]:
    """Remarks on scans whose colour (`diffuse_colour`, by scan) is another order of those before.

    The first scan's order is taken for right.
    """
    reference: FloatArray | None = None
    found: dict[str, list[int]] = {}
    for number, colour in colours.items():
        if not np.isfinite(colour).all():
            continue
        order = "" if reference is None else order_of(colour, reference)
        if order:
            found.setdefault(order, []).append(number)
        else:
            reference = colour
    return tuple(
        f"{_listed('scan', numbers)}: colours are those of the scan before if the channels are "
        f"{order}: these files, or all others, seem to have another order than B, G, R"
        for order, numbers in found.items()
    )


def check_parameters(colour: FloatArray, diffuse_albedo: ArrayLike) -> tuple[str, ...]:
    """Remarks on a colour (`diffuse_colour`) against Kd (3,) of ``brdf-params.txt``."""
    albedo = np.asarray(diffuse_albedo, dtype=np.float64)
    if not (np.isfinite(colour).all() and (albedo > 0).all()):
        return ()
    order = order_of(centred(np.log(albedo)), colour)
    if not order:
        return ()
    return (
        f"Kd in brdf-params.txt agrees with the radiances if its channels are {order}: they, or "
        "the radiances, seem to have another order than B, G, R",
    )


def check_name(name: str, colour: FloatArray) -> tuple[str, ...]:
    """Remarks on a colour (`diffuse_colour`) that a word of the sample's name speaks against."""
    if not np.isfinite(colour).all():
        return ()
    for word in re.split(r"[^a-z]+", name.lower()):
        brighter, darker = _NAMED_COLOURS.get(word, (0, 0))
        if colour[darker] - colour[brighter] > COLOUR:
            what = ("blue", "green", "red")
            return (
                f"the sample's name {name!r} says {word}, but {what[darker]} is "
                f"{np.exp(colour[darker] - colour[brighter]):.2g} times as bright as "
                f"{what[brighter]}: do the files have another order than B, G, R?",
            )
    return ()
