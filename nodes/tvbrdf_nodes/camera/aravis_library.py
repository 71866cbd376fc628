"""Finds Aravis, a library that comes with the system's packages, from any virtual environment."""

from __future__ import annotations

import importlib.util
import sys
import warnings
from pathlib import Path
from typing import Any

from ..core.device import DeviceError

SYSTEM_PACKAGES = Path("/usr/lib/python3/dist-packages")
"""Where Debian puts Python modules; only ``gi`` is taken from there."""
INSTALL = (
    "install Debian's packages: apt-get install gir1.2-aravis-0.8 python3-gi (python3-gi is built "
    "for the system's Python: the environment needs the same minor version)"
)


def load_aravis() -> Any:
    """Return the module Aravis, version 0.8.

    Raises
    ------
    DeviceError
        If it is not there; the text says what to install.
    """
    try:
        gi = _import_gi()
        gi.require_version("Aravis", "0.8")
        with warnings.catch_warnings():
            # its importer is of an old kind, which Python 3.11 warns of
            warnings.simplefilter("ignore", ImportWarning)
            from gi.repository import Aravis
    except (ImportError, ValueError) as error:
        version = f"{sys.version_info.major}.{sys.version_info.minor}"
        raise DeviceError(
            f"no Aravis for Python {version} ({error}); GenICam cameras need it: {INSTALL}"
        ) from error
    return Aravis


def _import_gi() -> Any:
    """Import ``gi`` from this environment, else from the system's packages, and nothing else."""
    try:
        import gi
    except ImportError:
        folder = SYSTEM_PACKAGES / "gi"
        spec = importlib.util.spec_from_file_location(
            "gi", folder / "__init__.py", submodule_search_locations=[str(folder)]
        )
        if spec is None or spec.loader is None or not folder.is_dir():
            raise
        gi = importlib.util.module_from_spec(spec)
        sys.modules["gi"] = gi
        try:
            spec.loader.exec_module(gi)
        except ImportError:
            del sys.modules["gi"]
            raise
    return gi
