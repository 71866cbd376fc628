"""The cells of speed against error as text and as comma-separated values."""

from __future__ import annotations

import csv
import io
import os
import platform
from collections.abc import Iterable, Mapping, Sequence

from .grid import FULL_PRECISION, Cell, alike

_OURS = "separable"
_LARGEST = 1e4
_LEGEND = (
    "Errors in per cent: median / what 95 % of the fits stay below. BRDF: relative RMS over\n"
    "all directions below 80 degrees. sigma_d^2, log sigma_s: absolute, x 100. t: nothing else is\n"
    "both faster and better at this noise; n: nothing else needs fewer images (lights x cameras)\n"
    "and is better; better: by the 95 % of the BRDF, by more than 2 %."
)


def machine() -> str:
    """Return what the times were taken on."""
    cores = f"one of {os.cpu_count()} cores"
    return f"{platform.platform()}, Python {platform.python_version()}, {cores}"


def as_text(cells: Sequence[Cell]) -> str:
    """Return for each noise: error by lights and cameras, times by solver, errors of parameters."""
    parts = []
    for noise in dict.fromkeys(cell.noise for cell in cells):
        own = [cell for cell in cells if cell.noise == noise]
        parts.append("AS MEASURED" if noise is None else f"NOISE {noise:.1%} AT WHITE")
        parts += [_by_cameras(own), _by_solver(own), _parameters(own)]
    return "\n\n".join([*parts, _LEGEND])


def as_csv(rows: Sequence[Mapping[str, object]]) -> str:
    """Return all cells with all their figures."""
    out = io.StringIO()
    writer = csv.DictWriter(out, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue()


def _by_cameras(cells: Sequence[Cell]) -> str:
    own = [c for c in cells if (c.solver, c.precision) == (_OURS, FULL_PRECISION)]
    cameras = sorted({c.cameras for c in own})
    rows = []
    for lights in _lights(own):
        found = (_one(own, lights=lights, cameras=n) for n in cameras)
        rows.append([str(lights), *(f"{_pair(c.brdf, c.brdf_95)} {_front(c)}" for c in found)])
    heads = ["lights", *(f"{n} camera{'s' if n > 1 else ''}   " for n in cameras)]
    return _columns(f"Error of the BRDF, {_OURS}", heads, rows)


def _by_solver(cells: Sequence[Cell]) -> str:
    cameras = max(c.cameras for c in cells)
    own = [c for c in cells if (c.cameras, c.precision) == (cameras, FULL_PRECISION)]
    solvers = list(dict.fromkeys(c.solver for c in own))
    rows = []
    for lights in _lights(own):
        ours, row = _one(own, lights=lights, solver=_OURS), [str(lights)]
        for solver in solvers:
            cell = _one(own, lights=lights, solver=solver)
            same = alike(cell.brdf_95, ours.brdf_95)
            other = "" if same else f" ({_number(100 * cell.brdf_95)})"
            row.append(f"{cell.time_ms:.3g}{other} {_front(cell)}")
        rows.append(row)
    title = (
        f"Time of a fit in ms (geometry and solving), {cameras} cameras (95 % of the BRDF's error, "
        f"where it is not that of {_OURS})"
    )
    return _columns(title, ["lights", *(f"{solver}   " for solver in solvers)], rows)


def _parameters(cells: Sequence[Cell]) -> str:
    cameras = max(c.cameras for c in cells)
    own = [c for c in cells if (c.cameras, c.solver) == (cameras, _OURS)]
    precisions = list(dict.fromkeys(c.precision for c in own))
    real = own[0].rms_percent is not None
    heads = ["lights", "Kd", "Ks", "sigma_d^2", "log sigma_s", *(["RMS %"] if real else [])]
    rows = []
    for lights in _lights(own):
        c = _one(own, lights=lights, precision=FULL_PRECISION)
        row = [
            str(lights),
            _pair(c.kd, c.kd_95),
            _pair(c.ks, c.ks_95),
            _pair(c.sigma_d_squared, c.sigma_d_squared_95),
            _pair(c.log_sigma_s, c.log_sigma_s_95),
        ]
        if c.rms_percent is not None and c.rms_percent_95 is not None:
            row.append(_pair(c.rms_percent / 100, c.rms_percent_95 / 100))
        given = (_one(own, lights=lights, precision=precision) for precision in precisions)
        rows.append([*row, *(_number(100 * cell.brdf_95) for cell in given)])
    title = (
        f"Errors of the parameters, {_OURS}, {cameras} cameras; and 95 % of the BRDF's error with "
        f"data of less precision"
    )
    return _columns(title, [*heads, *precisions], rows)


def _lights(cells: Iterable[Cell]) -> list[int]:
    return sorted({c.lights for c in cells})


def _one(cells: Iterable[Cell], **wanted: object) -> Cell:
    return next(c for c in cells if all(getattr(c, n) == value for n, value in wanted.items()))


def _columns(title: str, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    widths = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
    lines = [
        "  " + "   ".join(text.rjust(width) for text, width in zip(line, widths, strict=True))
        for line in (heads, *rows)
    ]
    return "\n".join([title, *(line.rstrip() for line in lines)])


def _front(cell: Cell) -> str:
    return ("t" if cell.fast else " ") + ("n" if cell.few else " ")


def _pair(median: float, most: float) -> str:
    """Return two shares in per cent."""
    return f"{_number(100 * median)} / {_number(100 * most)}"


def _number(value: float) -> str:
    return f"{value:.2g}" if value < 100 else f"{value:.0f}" if value < _LARGEST else "> 10000"
