"""Every message of the rig, one immutable class each.

Units are in the names. Stamps (``stamp_ns``, ``received_ns``, ``hardware_ns``) travel in the
header, see :class:`~tvbrdf_messages.envelope.Header`. Colours are in B, G, R order.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from .schema import Message, array_field

if TYPE_CHECKING:  # numpy is loaded by those who touch arrays only
    import numpy as np
    from numpy.typing import NDArray

    Bools = NDArray[np.bool_]
    Doubles = NDArray[np.float64]
    Longs = NDArray[np.int64]
    Pixels = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class Clock(Message):
    """The run's clock, told by its owner: the world in simulation, the player in replay."""

    now_ns: int
    epoch: int = 0
    """Counts jumps (loop, seek): buffers of an older epoch are emptied."""
    speedup: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanCommand(Message):
    """What the sequencer wants done next, and until when that still makes sense.

    ``action``: ``home``, ``prepare`` (arm to the start of the sweep, cameras to the exposure),
    ``sweep``, ``end_sweep``, ``dark`` (``frames`` frames with the lamp off), ``lamp``, ``jog``,
    ``still`` (one frame at each of ``exposures_ms``) or ``stop``.
    """

    command_id: int
    incarnation: str
    """The sequencer's: commands of an earlier one are refused."""
    not_after_ns: int
    action: str
    target: str = "all"
    """``all``, ``arm``, ``cameras`` or one camera's name."""
    sample: str = ""
    scan: int = 0
    sweep: int = 0
    attempt: int = 0
    scan_time_s: float = 0.0
    """Time of the scan since t = 0 (the mark, or the first scan)."""
    scan_start_ns: int = 0
    from_deg: float = 0.0
    to_deg: float = 0.0
    duration_s: float = 0.0
    exposure_ms: float = 0.0
    exposures_ms: tuple[float, ...] = ()
    lamp: bool = False
    frames: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepResult(Message):
    """What came of one command: also the mark that ends a device's part of a sweep."""

    source: str
    command_id: int
    action: str
    state: str
    """``done``, ``broken`` or ``refused``."""
    reason: str = ""
    sample: str = ""
    scan: int = 0
    sweep: int = 0
    attempt: int = 0
    frames: int = 0
    first_sequence: int = 0
    """Sequence number of the first frame or state sent for it; -1 when none was."""
    last_sequence: int = 0
    exposure_ms: float = 0.0
    """As read back from the device."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmState(Message):
    """Where the light is, at the header's stamps (``hardware_ns``: the controller's own ticks)."""

    angle_deg: float
    speed_deg_s: float
    lamp: bool
    moving: bool
    homed: bool
    fault: str = ""
    emergency_stop: bool = False
    one_way_delay_ns: int = 0
    """Fixed serial latency, from the fastest round trips."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraInfo(Message):
    """What a camera is and how it is set; latched."""

    camera: str
    model: str
    serial: str
    width: int
    height: int
    bit_depth: int
    region_x: int
    region_y: int
    hardware_stamps: bool
    exact_exposure: bool
    frame_rate_hz: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame(Message):
    """One image, with the exposure as read back from the camera."""

    camera: str
    kind: str
    """``light``, ``dark`` or ``still``."""
    sample: str
    scan: int
    sweep: int
    attempt: int
    index: int
    exposure_ms: float
    bit_depth: int
    region_x: int
    region_y: int
    image: Pixels = array_field("uint8", "uint16", "float32", shape=(None, None, 3))


@dataclass(frozen=True, slots=True, kw_only=True)
class Radiance(Message):
    """One scan as the cameras saw it: ``n`` observations, one a frame, not resampled.

    ``radiance`` is π·BRDF·cosθi (1: a perfect white diffuser facing the light). The ``grid_``
    arrays hold the exposures merged onto one grid of light positions, for the text files only.
    """

    sample: str
    scan: int
    attempt: int
    scan_time_s: float
    scan_start_ns: int
    exposures_ms: tuple[float, ...]
    cameras: tuple[str, ...]
    gain_relative_std: float
    """Of each camera's and channel's radiometric constant: an error that all scans share."""
    quality: dict[str, Any]
    """Gaps, retakes, dark levels, lamp drift, light offsets: what a reader must know of it."""
    camera: Longs = array_field("int64", shape=(None,))
    sweep: Longs = array_field("int64", shape=(None,))
    exposure_ms: Doubles = array_field("float64", shape=(None,))
    stamp_ns: Longs = array_field("int64", shape=(None,))
    light_angle_deg: Doubles = array_field("float64", shape=(None,))
    light_direction: Doubles = array_field("float64", shape=(None, 3))
    view_direction: Doubles = array_field("float64", shape=(None, 3))
    radiance: Doubles = array_field("float64", shape=(None, 3))
    variance: Doubles = array_field("float64", shape=(None, 3))
    valid: Bools = array_field("bool", shape=(None, 3))
    light_angle_std_deg: Doubles = array_field("float64", shape=(None,))
    """Of each sweep: an error that all its frames share."""
    grid_angle_deg: Doubles = array_field("float64", shape=(None,))
    grid_radiance: Doubles = array_field("float64", shape=(None, None, 3))
    grid_variance: Doubles = array_field("float64", shape=(None, None, 3))
    grid_valid: Bools = array_field("bool", shape=(None, None, 3))
    frame_relative_std: tuple[float, ...] = ()
    """Of each camera: the part of a frame's noise, as a part of the signal, that its channels share
    (the lamp's flicker); it is in ``variance`` already."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters(Message):
    """What a model's parameters are in one scan, in the published units (1/σs), with errors."""

    sample: str
    scan: int
    scan_time_s: float
    model: str
    """Full name; it also records the form of a dust model."""
    parameter_names: tuple[str, ...]
    values: tuple[float, ...]
    standard_deviations: tuple[float, ...]
    at_bound: tuple[str, ...]
    undetermined: tuple[str, ...]
    errors: dict[str, Any]
    """All error measures, by name."""
    chi_square: float
    degrees_of_freedom: int
    model_error_std: float
    """Added to the noise because the model can't explain the data without; in the metric's unit."""
    reason: str
    """Why the solver stopped."""
    solver: str
    evaluations: int
    solve_time_ms: float
    details: dict[str, Any]
    """``metric``, ``loss``, ``down_weighted``; ``nuisances`` (errors that frames share, as found:
    value and deviation by name); ``choice`` (why this model, and every one that was tried)."""
    covariance: Doubles = array_field("float64", shape=(None, None))


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanMissing(Message):
    """A scan that could not be measured within its time slot, and why."""

    sample: str
    scan: int
    scan_time_s: float
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Stored(Message):
    """The database has it on disk; who kept it may forget it."""

    sample: str
    scan: int
    what: str
    """``radiance``, ``parameters``, ``missing`` or ``mark``."""
    already: bool = False
    refused: str = ""
    """Why it is not on disk and never will be, for what it is; empty if it is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DatabaseState(Message):
    """What a database holds, told at every change; latched: a restarted sequencer goes on there."""

    sample: str
    scans: tuple[int, ...]
    fitted: tuple[int, ...]
    missing: tuple[int, ...]
    zero_ns: int = 0
    """Run-clock time of t = 0; 0 when nothing was stored yet."""
    last_ns: int = 0
    """Run-clock time of its latest scan, measured or missing; 0 when there is none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanStatus(Message):
    """How far the measurement is, for people."""

    state: str
    sample: str
    scan: int
    scans: int
    sweep: int
    sweeps: int
    fraction: float
    """Of the whole measurement, 0 to 1."""
    remaining_s: float
    """On the run's clock; negative when it depends on the operator."""
    text: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mark(Message):
    """An operator's note; ``zero`` says that this moment is t = 0 (the paint was applied)."""

    text: str
    zero: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class OperatorRequest(Message):
    """What a person asks of the sequencer from the command line."""

    request_id: str
    verb: str
    arguments: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class OperatorReply(Message):
    """The answer to one request."""

    request_id: str
    ok: bool
    text: str
    data: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class Diagnostics(Message):
    """How a node is: state, counters (sent, received, gaps, refused), what it waits for."""

    node: str
    state: str
    """``waiting``, ``ready``, ``running``, ``fault`` or ``stopping``."""
    text: str = ""
    missing_readers: tuple[str, ...] = ()
    counters: dict[str, Any] = field(default_factory=dict)
    resident_mb: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Log(Message):
    """One line of a node's log."""

    node: str
    level: str
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class SimScene(Message):
    """The scene under the simulated rig; latched. Simulated devices only."""

    scene: dict[str, Any]
    zero_ns: int
    """Run-clock time at which the simulation began."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SimGrant(Message):
    """Simulated devices may work up to this moment of the run's clock; latched."""

    until_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class SimHorizon(Message):
    """A simulated device is done with everything up to this moment."""

    device: str
    until_ns: int
    idle: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class SimMotion(Message):
    """The light's true motion, final up to ``until_ns``, as pieces of constant acceleration.

    Piece k: from ``start_ns[k]`` on, angle = a + v·t + ½·b·t² (degrees, seconds), lamp on or off.
    """

    until_ns: int
    start_ns: tuple[int, ...]
    angle_deg: tuple[float, ...]
    speed_deg_s: tuple[float, ...]
    acceleration_deg_s2: tuple[float, ...]
    lamp: tuple[bool, ...]
