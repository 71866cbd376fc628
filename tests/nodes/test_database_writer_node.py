"""The database writer's node: each message once however often it comes, and an answer to each."""

from __future__ import annotations

import resource
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tvbrdf_fitting.geometry import CAMERA_ANGLES_DEG, light_direction, view_direction
from tvbrdf_fitting.measurement.light_grid import grid_angles_deg
from tvbrdf_fitting.models import SURFACE, get_model
from tvbrdf_fitting.published import read_parameters
from tvbrdf_fitting.published.database import StoredSample, read_database
from tvbrdf_messages.messages import (
    DatabaseState,
    Mark,
    Parameters,
    Radiance,
    ScanMissing,
    Stored,
)
from tvbrdf_messages.run_directory import Graph
from tvbrdf_nodes.core.device import DeviceError
from tvbrdf_nodes.database_writer import node as writer_module

if TYPE_CHECKING:
    from conftest import MakeStage, Stage

CAMERAS = ("camera_1", "camera_2", "camera_3", "camera_4")
EXPOSURES_MS = (0.2, 4.0)
CALIBRATION = str(Path(__file__).resolve().parents[2] / "launch" / "calibration.yaml")
ZERO_NS = 1_700_000_000_000_000_000


def radiance(scan: int, *, sample: str = "paint", seed: int = 0, **changes: Any) -> Radiance:
    """Return one scan of a grey wall, noisy."""
    random = np.random.default_rng([scan, seed])
    angle_deg = np.arange(-70.0, 71.0, 10.0)
    light = np.tile(light_direction(angle_deg), (8, 1))
    n = len(light)
    camera = np.repeat(np.arange(1, 5), n // 4)
    view = np.array([view_direction(a) for a in CAMERA_ANGLES_DEG])[camera - 1]
    grid_deg = grid_angles_deg()
    valid = np.abs(grid_deg) < 60.0
    grid = np.where(valid[None, :, None], random.uniform(0.1, 0.9, (4, grid_deg.size, 3)), np.nan)
    message = Radiance(
        sample=sample,
        scan=scan,
        attempt=1,
        scan_time_s=60.0 * (scan - 1),
        scan_start_ns=ZERO_NS + 60_000_000_000 * (scan - 1),
        exposures_ms=EXPOSURES_MS,
        cameras=CAMERAS,
        gain_relative_std=1e-3,
        quality={"lamp_factor": [1.0, 2.0]},
        camera=camera,
        sweep=np.tile(np.repeat([0, 1], angle_deg.size), 4),
        exposure_ms=np.tile(np.repeat(EXPOSURES_MS, angle_deg.size), 4),
        stamp_ns=ZERO_NS + np.arange(n) * 33_000_000,
        light_angle_deg=np.tile(angle_deg, 8),
        light_direction=light,
        view_direction=view,
        radiance=random.uniform(0.1, 0.9, (n, 3)),
        variance=np.full((n, 3), 1e-6),
        valid=np.ones((n, 3), dtype=np.bool_),
        light_angle_std_deg=np.full(2, 0.01),
        grid_angle_deg=grid_deg,
        grid_radiance=grid,
        grid_variance=np.full(grid.shape, 1e-6),
        grid_valid=np.isfinite(grid),
        frame_relative_std=(1e-3,) * 4,
    )
    return replace(message, **changes)


def parameters(scan: int, *, model: str = SURFACE, sample: str = "paint") -> Parameters:
    names = get_model(model).parameter_names
    values = np.random.default_rng(scan).uniform(0.1, 0.9, len(names))
    return Parameters(
        sample=sample,
        scan=scan,
        scan_time_s=60.0 * (scan - 1),
        model=model,
        parameter_names=names,
        values=tuple(values.tolist()),
        standard_deviations=tuple((values / 100).tolist()),
        at_bound=(),
        undetermined=(),
        errors={"rms_percent": 0.5},
        chi_square=100.0,
        degrees_of_freedom=90,
        reason="converged",
        solver="lm",
        evaluations=10,
        model_error_std=0.001,
        solve_time_ms=12.0,
        details={"metric": "radiance", "nuisances": {"gain_camera1_b": [0.001, 0.0005]}},
        covariance=np.diag((values / 100) ** 2),
    )


class Desk:
    """A running database writer, with the test as merger, fitter and sequencer."""

    def __init__(
        self, make_stage: MakeStage, database: Path, utc_ns: int = 10**18, **more: Any
    ) -> None:
        given = {"path": str(database), "sample": "paint"} | more
        sequence = {"sample": "paint", "cameras": CAMERAS[:1]}
        self.path = database
        self.stage: Stage = make_stage(
            ("arm", "arm"),
            ("camera_1", "camera", {"driver": "tvbrdf_nodes.camera.simulated:SimulatedCamera"}),
            ("hdr_merger", "hdr_merger", {"calibration": CALIBRATION, "cameras": CAMERAS[:1]}),
            ("fitter", "fitter"),
            ("sequencer", "sequencer", sequence),
            ("database_writer", "database_writer", given, True),
            utc_ns=utc_ns,
        )
        self.stage.begin()

    def merge(self, scan: int, **changes: Any) -> list[Stored]:
        message = radiance(scan, **changes)
        self.stage.players["hdr_merger"].say("/scan/radiance", message, keep=str(scan))
        return self.confirmed()

    def fit(self, scan: int, **changes: Any) -> list[Stored]:
        message = parameters(scan, **changes)
        self.stage.players["fitter"].say("/scan/parameters", message, keep=str(scan))
        return self.confirmed()

    def miss(self, scan: int, reason: str = "no light", sample: str = "paint") -> list[Stored]:
        message = ScanMissing(
            sample=sample, scan=scan, scan_time_s=60.0 * (scan - 1), reason=reason
        )
        self.stage.players["sequencer"].say("/scan/missing", message)
        return self.confirmed()

    def mark(self, text: str, stamp_ns: int = 5, *, zero: bool = False) -> list[Stored]:
        message = Mark(text=text, zero=zero)
        self.stage.players["sequencer"].say("/operator/mark", message, stamp_ns=stamp_ns)
        return self.confirmed()

    def confirmed(self) -> list[Stored]:
        return self.stage.players["sequencer"].take(Stored)

    def state(self) -> DatabaseState:
        (self.last_state,) = self.stage.players["sequencer"].take(DatabaseState)
        return self.last_state

    def sample(self) -> StoredSample:
        (sample,) = read_database(self.path).samples
        return sample

    @property
    def counters(self) -> dict[str, Any]:
        return self.stage.graph.runners["database_writer"].node.diagnostics()


def stored(scan: int, what: str, *, already: bool = False) -> Stored:
    return Stored(sample="paint", scan=scan, what=what, already=already)


@pytest.fixture
def desk(make_stage: MakeStage, tmp_path: Path) -> Desk:
    return Desk(make_stage, tmp_path / "db")


def test_each_thing_is_stored_and_confirmed(desk: Desk) -> None:
    assert desk.state() == DatabaseState(sample="paint", scans=(), fitted=(), missing=())
    assert desk.merge(1) == [stored(1, "radiance")]
    assert desk.fit(1) == [stored(1, "parameters")]
    assert desk.miss(2) == [stored(2, "missing")]
    assert desk.mark("painted") == [stored(0, "mark")]
    assert desk.mark("window opened", 7) == [stored(1, "mark")]
    sample = desk.sample()
    assert [scan.scan for scan in sample.scans] == [1]
    assert [(m.scan, m.reason) for m in sample.missing] == [(2, "no light")]
    assert [(note.stamp_ns, note.text) for note in sample.notes] == [
        (5, "painted"),
        (7, "window opened"),
    ]
    fit = sample.scans[0].fit
    assert fit is not None
    assert tuple(fit.values) == parameters(1).values
    rows = read_parameters(sample.folder / "tvBrdf-fits" / "brdf-params.txt")
    np.testing.assert_allclose(rows, [parameters(1).values], rtol=0, atol=5e-7)


def test_what_was_seen_is_kept_bit_for_bit(desk: Desk) -> None:
    desk.merge(1)
    scan = desk.sample().scans[0]
    kept, sent = scan.observations(), radiance(1)
    names = ("camera", "sweep", "stamp_ns", "radiance", "variance", "valid", "grid_radiance")
    for name in names:
        array = getattr(sent, name)
        assert kept[name].dtype == array.dtype
        assert kept[name].tobytes() == array.tobytes()
    assert scan.quality["gain_relative_std"] == 1e-3
    assert scan.quality["frame_relative_std"] == [1e-3] * 4
    assert scan.quality["lamp_factor"] == [1.0, 2.0]
    assert (scan.quality["attempt"], scan.quality["cameras"]) == (1, list(CAMERAS))
    assert (scan.start_stamp_ns, scan.time_s) == (ZERO_NS, 0.0)


def test_however_often_something_comes_it_is_stored_once(desk: Desk) -> None:
    for times in range(3):
        assert desk.merge(1) == [stored(1, "radiance", already=times > 0)]
        assert desk.fit(1) == [stored(1, "parameters", already=times > 0)]
        assert desk.miss(2) == [stored(2, "missing", already=times > 0)]
        assert [s.already for s in desk.mark("painted")] == [times > 0]
    sample = desk.sample()
    assert ([s.scan for s in sample.scans], len(sample.missing), len(sample.notes)) == ([1], 1, 1)
    assert desk.counters["stored"] == 4
    assert desk.counters["already_stored"] == 8


def test_another_content_under_the_same_number_does_not_replace_the_first(desk: Desk) -> None:
    desk.merge(1)
    assert desk.merge(1, seed=1) == [stored(1, "radiance", already=True)]
    sample = desk.sample()
    assert sample.scans[0].observations()["radiance"].tobytes() == radiance(1).radiance.tobytes()
    assert "scan 1 came again with another content" in sample.notes[0].text


def test_parameters_that_come_before_their_scan_wait_for_it(desk: Desk) -> None:
    assert desk.fit(1) == []
    assert desk.fit(2) == []
    assert desk.counters["waiting"] == 2
    assert desk.merge(2) == [stored(2, "radiance"), stored(2, "parameters")]
    assert desk.merge(1) == [stored(1, "radiance"), stored(1, "parameters")]
    assert desk.counters["waiting"] == 0
    fits = [scan.fit for scan in desk.sample().scans]
    assert [tuple(fit.values) for fit in fits if fit] == [parameters(n).values for n in (1, 2)]


def test_a_restarted_writer_finds_its_own_database_and_gets_what_was_not_confirmed(
    desk: Desk, make_stage: MakeStage
) -> None:
    desk.merge(1)
    graph: Graph = desk.stage.graph.bus.graph
    desk.stage.end()
    # the same run: same graph, so the same run id
    second = Desk(make_stage, desk.path)
    assert second.stage.graph.bus.graph.utc_ns == graph.utc_ns
    assert second.state() == DatabaseState(
        sample="paint", scans=(1,), fitted=(), missing=(), zero_ns=ZERO_NS, last_ns=ZERO_NS
    )
    assert second.merge(1) == [stored(1, "radiance", already=True)]
    assert second.fit(1) == [stored(1, "parameters")]


def test_another_run_must_be_told_to_go_on(desk: Desk, make_stage: MakeStage) -> None:
    """Also one in a run directory of the same name."""
    desk.merge(1)
    desk.miss(2)
    desk.stage.end()
    later_ns = desk.stage.graph.bus.graph.utc_ns + 1
    with pytest.raises(DeviceError, match="holds 2 scans of sample 'paint'; say resume:=true"):
        Desk(make_stage, desk.path, utc_ns=later_ns)
    again = Desk(make_stage, desk.path, utc_ns=later_ns, resume=True)
    assert again.state().scans == (1,)
    again.stage.end()
    with pytest.raises(DeviceError, match="is the database of sample 'paint', not of 'cloth'"):
        Desk(make_stage, desk.path, utc_ns=later_ns, resume=True, sample="cloth")


def test_its_state_tells_t_0_and_the_latest_scan(desk: Desk, make_stage: MakeStage) -> None:
    desk.merge(1)
    desk.mark("painted", ZERO_NS - 30_000_000_000, zero=True)
    desk.miss(4)
    desk.stage.end()
    state = Desk(make_stage, desk.path).state()
    assert (state.scans, state.missing) == ((1,), (4,))
    assert state.zero_ns == ZERO_NS - 30_000_000_000
    assert state.last_ns == state.zero_ns + 180_000_000_000


def test_its_state_is_always_what_it_holds(desk: Desk) -> None:
    """It is latched: a sequencer that is restarted goes on from it."""
    desk.state()
    desk.merge(1)
    assert (desk.state().scans, desk.last_state.fitted) == ((1,), ())
    desk.fit(1)
    assert (desk.state().scans, desk.last_state.fitted) == ((1,), (1,))
    desk.miss(2)
    assert desk.state().missing == (2,)
    desk.mark("painted", ZERO_NS - 30_000_000_000, zero=True)
    assert desk.state().zero_ns == ZERO_NS - 30_000_000_000
    desk.fit(1)  # nothing new
    assert desk.stage.players["sequencer"].take(DatabaseState) == []


# -- what is stored and not fitted


def sent_back(desk: Desk) -> dict[int, Radiance]:
    """Return the radiance that the database has sent, by scan."""
    found = {}
    for envelope in desk.stage.said("/scan/radiance"):
        if envelope.header.publisher == "database_writer":
            assert isinstance(envelope.message, Radiance)
            found[envelope.message.scan] = envelope.message
    return found


def expect_same(found: Radiance, sent: Radiance) -> None:
    for part in Radiance.schema():
        one, other = getattr(found, part.name), getattr(sent, part.name)
        if part.array:
            assert (one.dtype, one.shape) == (other.dtype, other.shape), part.name
            assert one.tobytes() == other.tobytes(), part.name
        else:
            assert one == other, part.name


def test_what_was_not_fitted_is_sent_again_as_it_came(desk: Desk, make_stage: MakeStage) -> None:
    for scan in (1, 2, 4):
        desk.merge(scan, attempt=scan)
    desk.fit(2)
    desk.miss(3)
    assert sent_back(desk) == {}
    desk.stage.end()
    later_ns = desk.stage.graph.bus.graph.utc_ns + 1
    again = Desk(make_stage, desk.path, utc_ns=later_ns, resume=True)
    found = sent_back(again)
    assert sorted(found) == [1, 4]
    assert {message.scan for message in again.stage.players["fitter"].take(Radiance)} == {1, 4}
    for scan, message in found.items():
        expect_same(message, radiance(scan, attempt=scan))
    assert again.fit(1) == [stored(1, "parameters")]
    assert again.fit(4) == [stored(4, "parameters")]
    assert [scan.fit is not None for scan in again.sample().scans] == [True] * 3


@pytest.mark.parametrize("name", ["fitter", "sequencer"])
def test_it_is_sent_again_to_a_fitter_that_was_restarted(desk: Desk, name: str) -> None:
    """Its merger may have been lost with it; the sequencer may wait for it."""
    desk.merge(1)
    desk.merge(2)
    desk.fit(1)
    player = desk.stage.players[name]
    player.die()
    player.return_()
    assert sorted(sent_back(desk)) == [2]


def test_who_needs_no_radiance_starts_nothing(desk: Desk) -> None:
    desk.merge(1)
    desk.stage.players["hdr_merger"].die()
    desk.stage.players["hdr_merger"].return_()
    assert sent_back(desk) == {}


@pytest.mark.parametrize(
    ("spoil", "text"),
    [
        (lambda arrays: arrays.pop("valid"), "'valid' is missing"),
        (
            lambda arrays: arrays.update(radiance=arrays["radiance"][:, :2]),
            "radiance: shape (120, 2), expected n×3",
        ),
    ],
)
def test_observations_that_are_not_whole_are_told_and_the_others_sent(
    desk: Desk, make_stage: MakeStage, spoil: Callable[[dict[str, Any]], Any], text: str
) -> None:
    desk.merge(1)
    desk.merge(2)
    desk.stage.end()
    first = desk.sample().scans[0]
    arrays = first.observations()
    spoil(arrays)
    size = first.observations_path.stat().st_size
    np.savez(first.observations_path, **arrays)  # type: ignore[arg-type]
    with first.observations_path.open("ab") as file:  # a size that the catalogue knows
        file.write(bytes(size - first.observations_path.stat().st_size))
    again = Desk(make_stage, desk.path, resume=True)
    assert sorted(sent_back(again)) == [2]
    answer = again.confirmed()[0]
    assert (answer.scan, answer.what, answer.already) == (1, "parameters", False)
    assert str(first.observations_path) in answer.refused
    assert text in answer.refused
    assert answer.refused in again.stage.log("error")


# -- what can't be stored


@pytest.mark.parametrize("what", ["merge", "fit", "miss"])
def test_what_is_of_another_sample_is_refused(desk: Desk, what: str) -> None:
    desk.merge(1)
    sends: dict[str, Callable[..., list[Stored]]] = {
        "merge": desk.merge,
        "fit": desk.fit,
        "miss": desk.miss,
    }
    send = sends[what]
    (answer,) = send(1 if what == "fit" else 2, sample="cloth")
    assert not answer.already
    assert answer.refused.endswith("is the database of sample 'paint'; what was sent is of 'cloth'")
    assert [scan.scan for scan in desk.sample().scans] == [1]
    assert desk.sample().missing == ()
    assert answer.refused in desk.stage.log("error")


def test_a_scan_without_a_valid_value_is_refused_and_its_parameters_too(desk: Desk) -> None:
    nothing = np.zeros((4, grid_angles_deg().size, 3), dtype=np.bool_)
    (answer,) = desk.merge(1, grid_valid=nothing)
    assert answer.what == "radiance"
    assert "no camera has a single valid radiance" in answer.refused
    (answer,) = desk.fit(1)
    assert (answer.what, bool(answer.refused)) == ("parameters", True)
    assert desk.miss(1) == [stored(1, "missing")]


def test_parameters_of_another_model_are_refused(desk: Desk) -> None:
    desk.merge(1)
    desk.merge(2)
    desk.fit(1)
    (answer,) = desk.fit(2, model="oren_nayar")
    assert "fit all with one model" in answer.refused


@contextmanager
def small_disk(limit_bytes: int) -> Iterator[None]:
    """Let no file grow beyond a size, as on a full disk (EFBIG)."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_is_tried_again_until_there_is_room(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer_module, "RETRY_S", 0.02)
    desk.merge(1)
    with small_disk(1000):
        assert desk.merge(2) == []
        assert desk.fit(2) == []
        tries = len(desk.stage.log("error"))
        assert tries
        assert "the disk is full" in desk.stage.log("error")[0]
        desk.stage.wait(lambda: len(desk.stage.log("error")) >= tries + 3)
        assert desk.counters["waiting"] == 2
        assert desk.confirmed() == []
    assert [scan.scan for scan in desk.sample().scans] == [1]
    found: list[Stored] = []

    def stored_both() -> bool:
        found.extend(desk.confirmed())
        return len(found) == 2

    desk.stage.wait(stored_both)
    assert found == [stored(2, "radiance"), stored(2, "parameters")]
    assert [scan.scan for scan in desk.sample().scans] == [1, 2]
    assert desk.counters["waiting"] == 0


def test_a_database_that_is_gone_ends_the_node(desk: Desk) -> None:
    """A new start may find it again; going on would lose what comes."""
    desk.merge(1)
    shutil.rmtree(desk.path / "sample01" / "tvBrdf-data")
    with pytest.raises(DeviceError, match="storing scan 2 failed"):
        desk.merge(2)


def test_a_database_of_other_people_is_not_touched(make_stage: MakeStage, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(DeviceError, match=r"is not empty and no database.*thesis\.tex"):
        Desk(make_stage, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["thesis.tex"]
