"""A scene: the sample under the rig, and each effect that makes its devices less than ideal.

Every effect is a field whose default is off; one that is off costs nothing. Scenes are YAML files:
samples in ``samples/``, sets of effects in ``effects/``, found by name or path.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ..core.parameters import ParameterError, build

HERE = Path(__file__).parent


class SceneError(ValueError):
    """A scene can't be used; the text names the file and the key."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmEffects:
    """What the simulated controller and its serial line do to the truth."""

    clock_offset_s: float = 0.0
    clock_drift_ppm: float = 0.0
    latency_ms: float = 0.0
    """Fixed, each way."""
    jitter_ms: float = 0.0
    """Mean of the exponential delay on top."""
    angle_offset_deg: float = 0.0
    """Error of the home position."""
    faults: tuple[dict[str, Any], ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraEffects:
    """What a simulated camera does to the truth. Each camera draws its own from these."""

    clock_offset_s: float = 0.0
    """Standard deviation over the cameras."""
    clock_drift_ppm: float = 0.0
    """Standard deviation over the cameras."""
    jitter_ms: float = 0.0
    """Mean of the exponential delay of a frame's arrival."""
    shot_noise: bool = False
    read_noise: bool = False
    quantisation: bool = False
    saturation: bool = True
    motion_blur: bool = False
    near_field: bool = False
    """Directions turn over the tray (analytic samples only)."""
    relative_noise_std: float = 0.0
    """Flicker from frame to frame, as a part of the signal."""
    gain_error_std: float = 0.0
    """Of each camera and channel against its calibration, as a part of the signal."""
    faults: tuple[dict[str, Any], ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class LampEffects:
    """What the lamp does."""

    warm_up_s: float = 0.0
    """Time constant with which it warms up and cools down."""
    warm_up_fraction: float = 1.0
    """Of its brightness that a cold lamp lacks."""
    drift_per_hour: float = 0.0
    """Relative change of its brightness."""
    ambient_radiance: float = 0.0
    """Stray light that stays when the lamp is off."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Everything that the simulated devices know and the real nodes do not."""

    sample: dict[str, Any]
    seed: int = 1
    arm: ArmEffects = field(default_factory=ArmEffects)
    camera: CameraEffects = field(default_factory=CameraEffects)
    lamp: LampEffects = field(default_factory=LampEffects)
    evolves_during_scan: bool = False
    """Off: the sample is frozen at the scan's time."""
    hidden_by_arm: bool = True

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, as they travel and as they are kept beside the results."""
        return asdict(self)


def scene_from_dict(raw: Mapping[str, Any], where: str = "scene") -> Scene:
    """Return the scene that :meth:`Scene.as_dict` gave."""
    try:
        return build(Scene, raw)
    except ParameterError as error:
        raise SceneError(f"{where}: {error}") from error


def available(folder: str) -> tuple[str, ...]:
    """Return the names of the shipped files in ``samples`` or ``effects``."""
    return tuple(sorted(path.stem for path in (HERE / folder).glob("*.yaml")))


def _load(folder: str, given: str) -> tuple[str, dict[str, Any]]:
    import yaml

    path = Path(given) if given.endswith((".yaml", ".yml")) else HERE / folder / f"{given}.yaml"
    if not path.is_file():
        known = ", ".join(available(folder))
        raise SceneError(
            f"no {folder.removesuffix('s')} {given!r}: {path} is missing; "
            f"give a .yaml file or one of: {known}"
        )
    try:
        raw = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        raise SceneError(f"{path}: not YAML: {error}") from error
    if not isinstance(raw, dict):
        raise SceneError(f"{path}: expected a mapping of keys to values")
    return str(path), raw


def load_scene(sample: str, effects: str, seed: int) -> Scene:
    """Return the scene of a sample and a set of effects.

    Parameters
    ----------
    sample
        Name of a shipped sample, path of a YAML file, or ``measured:PATH`` with a folder that
        holds ``tvBrdf-data/``.
    effects
        Name of a shipped set of effects, or path of a YAML file.
    seed
        Of everything that is drawn at random.
    """
    if sample.startswith("measured:"):
        path = Path(sample.removeprefix("measured:"))
        if not (path / "tvBrdf-data").is_dir():
            raise SceneError(f"sample {sample}: {path} holds no folder tvBrdf-data")
        spec: dict[str, Any] = {"kind": "measured", "path": str(path.resolve())}
    else:
        where, spec = _load("samples", sample)
        if "kind" not in spec:
            raise SceneError(f"{where}: key 'kind' is missing")
    where, raw = _load("effects", effects)
    return scene_from_dict({**raw, "sample": spec, "seed": seed}, where)
