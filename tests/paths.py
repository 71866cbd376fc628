"""Files of the repository that tests read."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CALIBRATION_FILE = ROOT / "launch" / "calibration.yaml"
