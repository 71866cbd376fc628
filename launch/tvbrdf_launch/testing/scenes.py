"""Scenes of a test: effects as mappings, and faults by device."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml

from tvbrdf_nodes.arm.simulated_faults import PlannedFault
from tvbrdf_nodes.camera.simulated_faults import CameraFault
from tvbrdf_nodes.core.parameters import ParameterError, build
from tvbrdf_nodes.world.scene import SceneError, available, load_scene

from .errors import MisuseError, unknown

Faults = Mapping[str, Iterable[Mapping[str, Any]]]
DEVICES = ("arm", "camera", "camera_1", "camera_2", "camera_3", "camera_4")
"""That can be given faults; ``camera``: all of them."""


def write_scene(folder: Path, arguments: dict[str, Any], default: str, faults: Faults) -> None:
    """Replace a sample and effects given as mappings by files, with faults among the effects.

    Parameters
    ----------
    folder
        Where the files are written.
    arguments
        Of the launch file; changed in place.
    default
        The effects where none are given.
    faults
        By device.
    """
    if isinstance(arguments.get("sample"), Mapping):
        arguments["sample"] = _write(folder / "sample.yaml", dict(arguments["sample"]))
    effects = arguments.get("effects", default)
    if isinstance(effects, Mapping):
        effects = arguments["effects"] = _write(folder / "effects.yaml", dict(effects))
    if faults:
        arguments["effects"] = _write(folder / "faults.yaml", _with_faults(str(effects), faults))


def _write(path: Path, content: Mapping[str, Any]) -> str:
    path.write_text(yaml.safe_dump(content))
    return str(path)


def _with_faults(effects: str, faults: Faults) -> dict[str, Any]:
    try:
        scene = load_scene(available("samples")[0], effects, 1).as_dict()
    except SceneError as error:
        raise MisuseError(str(error)) from error
    del scene["sample"], scene["seed"]
    found = {name: [dict(each) for each in scene[name]["faults"]] for name in ("arm", "camera")}
    for device, planned in faults.items():
        if device not in DEVICES:
            raise unknown("device", device, DEVICES)
        kind, _, number = device.partition("_")
        for fault in planned:
            raw = {"camera": int(number), **fault} if number else dict(fault)
            try:
                build(PlannedFault if kind == "arm" else CameraFault, raw)
            except ParameterError as error:
                raise MisuseError(f"fault {fault} of {device}: {error}") from error
            found[kind].append(raw)
    for name, listed in found.items():
        scene[name]["faults"] = listed
    return scene
