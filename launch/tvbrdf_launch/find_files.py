"""Launch files by name: those that ship with the project, or any by its path."""

from __future__ import annotations

import re
from pathlib import Path

from .errors import RunError, did_you_mean
from .launch_file import Declaration, load_declaration

_LAUNCH_KEY = re.compile(r"^(nodes|include):", re.MULTILINE)
_HERE = Path(__file__).resolve().parent


def shipped_directory() -> Path:
    """Return the folder of the launch files that ship: in a wheel, or in a source checkout."""
    for folder in (_HERE / "files", _HERE.parent):
        if (folder / "simulated_rig.yaml").is_file():
            return folder
    raise RunError(f"the launch files are missing: neither in {_HERE / 'files'} nor {_HERE.parent}")


def shipped() -> dict[str, Declaration]:
    """Return the shipped launch files by name; other YAML files beside them are left out."""
    found = {}
    for path in sorted(shipped_directory().glob("*.yaml")):
        if _LAUNCH_KEY.search(path.read_text()):
            found[path.stem] = load_declaration(path)
    return found


def find_launch_file(given: str) -> Path:
    """Return the launch file that a name or path stands for.

    Raises
    ------
    RunError
        If there is none; the text lists the names of those that ship.
    """
    path = Path(given)
    if path.suffix in (".yaml", ".yml") or len(path.parts) > 1:
        if path.is_file():
            return path
        raise RunError(f"no launch file {path}")
    path = shipped_directory() / f"{given}.yaml"
    if path.is_file():
        return path
    hint = did_you_mean(given, shipped(), "there are")
    raise RunError(f"no launch file {given!r}; {hint} (or give the path of a .yaml file)")
