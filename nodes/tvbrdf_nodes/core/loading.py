"""Classes by name, ``module:Class``: nodes, and drivers that users bring."""

from __future__ import annotations

import importlib
from typing import Any

NODES = {
    "world": "tvbrdf_nodes.world.node:WorldNode",
    "arm": "tvbrdf_nodes.arm.node:ArmNode",
    "arm_controller": "tvbrdf_nodes.arm.simulated:SimulatedController",
    "camera": "tvbrdf_nodes.camera.node:CameraNode",
    "hdr_merger": "tvbrdf_nodes.hdr_merger.node:HdrMergerNode",
    "fitter": "tvbrdf_nodes.fitter.node:FitterNode",
    "database_writer": "tvbrdf_nodes.database_writer.node:DatabaseWriterNode",
    "sequencer": "tvbrdf_nodes.sequencer.node:SequencerNode",
    "player": "tvbrdf_nodes.player.node:PlayerNode",
    "recorder": "tvbrdf_nodes.recorder.node:RecorderNode",
}
"""Short names of the nodes that ship with the project."""


class LoadingError(ValueError):
    """A class can't be found; the text says what was tried."""


def load_class(path: str) -> type[Any]:
    """Return the class that ``module:Class`` names."""
    module_name, separator, class_name = path.partition(":")
    if not separator or not class_name.isidentifier():
        raise LoadingError(f"{path!r} is not of the form package.module:Class")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise LoadingError(f"{path}: can't import {module_name}: {error}") from error
    found = getattr(module, class_name, None)
    if not isinstance(found, type):
        raise LoadingError(f"{path}: {module_name} has no class {class_name}")
    return found


def node_class_path(kind: str) -> str:
    """Return ``module:Class`` of a node given by its short name or by that path itself."""
    if ":" in kind:
        return kind
    if kind not in NODES:
        raise LoadingError(f"no node {kind!r}; there are: {', '.join(NODES)} (or module:Class)")
    return NODES[kind]
