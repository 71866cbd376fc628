"""What a simulation knows of its sample: ``truth.json`` in the database's folder.

``{"parameter_names": ["kd_b", ...], "scans": {"1": {"time_s": 0.0, "values": [...]}, ...}}``,
values in published units. A measurement of a real sample has no such file.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tvbrdf_fitting.published.database import DatabaseError

TRUTH_FILE = "truth.json"


@dataclass(frozen=True)
class Truth:
    """True parameters by scan and name, and the time of each scan in seconds since t = 0."""

    values: dict[int, dict[str, float]]
    time_s: dict[int, float]

    def of(self, scan: int, name: str) -> float | None:
        """Value of a parameter in a scan; None if it is not known."""
        return self.values.get(scan, {}).get(name)


def read_truth(folder: Path) -> Truth:
    """Read a database's ``truth.json``; an empty truth if it has none.

    Raises
    ------
    DatabaseError
        If the file is not of the form stated above.
    """
    path = folder / TRUTH_FILE
    if not path.exists():
        return Truth({}, {})
    try:
        content: Any = json.loads(path.read_text(encoding="utf-8"))
        names = [str(name) for name in content["parameter_names"]]
        values, time_s = {}, {}
        for key, entry in content["scans"].items():
            numbers = [float(value) for value in entry["values"]]
            values[int(key)] = dict(zip(names, numbers, strict=True))
            time_s[int(key)] = float(entry["time_s"])
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DatabaseError(
            f"{path}: is not of the form {{'parameter_names': [...], 'scans': {{'1': "
            f"{{'time_s': ..., 'values': [...]}}}}}}: {error!r}; correct or remove it"
        ) from error
    return Truth(values, time_s)
