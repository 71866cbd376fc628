"""``tvbrdf bag record``, a recorder in a launch file, and what people are told of it beforehand."""

from __future__ import annotations

import contextlib
import json
import resource
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import yaml

from tests.paths import CALIBRATION_FILE
from tvbrdf_launch.errors import LaunchError
from tvbrdf_launch.find_files import find_launch_file
from tvbrdf_launch.launch_file import load_launch_file
from tvbrdf_launch.plan import Plan, make_plan
from tvbrdf_launch.process_table import read_processes
from tvbrdf_launch.stop_order import stop_stages
from tvbrdf_messages.bag import BagReader, recover
from tvbrdf_messages.bus.watcher import Watcher
from tvbrdf_messages.run_directory import read_graph

if TYPE_CHECKING:
    from tests.launch.conftest import Run

RUN = Path("/run/t/1")
STILL_RIG = """\
description: for tests
nodes:
  - name: arm
    node: launch_test_nodes:Probe
    parameters: {gives: [/arm/state, /scan/status]}
  - name: reader
    node: launch_test_nodes:Probe
    parameters: {takes: [/arm/state]}
  - name: recorder
    node: recorder
    parameters: {path: PATH, floor_free_mb: 0}
    restart: on_failure
"""


def plan(name: str, **arguments: Any) -> Plan:
    given = {key: str(value) for key, value in arguments.items()}
    return make_plan(load_launch_file(find_launch_file(name), given, RUN), RUN)


# -- what a launch file makes of it


def test_without_a_path_there_is_no_recorder() -> None:
    assert "recorder" not in {node.name for node in plan("simulated_rig").nodes}


def test_the_recorder_takes_all_that_is_marked_as_recorded(tmp_path: Path) -> None:
    graph = plan("simulated_rig", record=tmp_path / "bag").graph
    recorder = graph.find("recorder")
    takes = set(recorder.takes)
    assert {f"/camera_{n}/{what}" for n in (1, 2, 3, 4) for what in ("frame", "info")} <= takes
    assert {"/arm/state", "/scan/command", "/scan/radiance", "/scan/parameters", "/operator/mark",
            "/scan/sweep_result", "/diagnostics", "/log", "/scan/missing"} <= takes  # fmt: skip
    assert not any(topic.startswith("/sim/") for topic in takes)
    assert recorder.counted_bytes == 4_000_000  # of a simulated rig
    assert not any(p.counted_bytes for p in graph.participants if p.name != "recorder")
    required = plan("simulated_rig", record=tmp_path / "bag", record_required="true").graph
    assert required.find("recorder").counted_bytes == 0


def test_it_is_stopped_after_all_that_it_hears_but_the_world(tmp_path: Path) -> None:
    stages = stop_stages(plan("simulated_rig", record=tmp_path / "bag").graph)
    assert [set(stage) for stage in stages[-3:]] == [
        {"database_writer"},
        {"recorder"},
        {"world", "arm_controller"},
    ]


SMALL = {"scans": 2, "sweep_s": 10, "exposures_ms": "[1, 50]", "dark_frames": 4, "width": 640}
# 10 s at 30 frames/s, 10 s at 20 frames/s (50 ms each), 2 x 4 dark ones: 508 frames of a camera;
# 4 cameras of 640 x 480 pixels with 3 x 2 bytes are 3.745 GB a scan
SCAN_GB = 4 * 508 * 640 * 480 * 6 / 1e9


def test_the_disk_that_it_needs_is_told_first(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    made = plan("simulated_rig", record=bag, height=480, **SMALL)
    (text,) = (line for line in made.notices if "warning" not in line)
    assert text == (
        f"recorder: records regions of interest into {bag}: "
        f"about {SCAN_GB:.1f} GB a scan, {2 * SCAN_GB:.1f} GB for 2"
    )
    eight = plan("simulated_rig", record=bag, height=480, bit_depth=8, **SMALL).notices[0]
    assert f"about {SCAN_GB / 2:.1f} GB a scan" in eight


def test_full_frames_need_more_where_the_calibration_uses_less(tmp_path: Path) -> None:
    content = yaml.safe_load(CALIBRATION_FILE.read_text())
    content["every_camera"]["patch"] = {"x": 0.25, "y": 0.25, "width": 0.4, "height": 0.4}
    content["every_camera"]["reference_patch"] = None
    calibration = tmp_path / "half.yaml"
    calibration.write_text(yaml.safe_dump(content))
    given = {"record": tmp_path / "bag", "height": 480, "calibration": calibration, **SMALL}
    text = plan("simulated_rig", **given).notices[0]
    # half of each side with its margins of 5 %
    assert f"about {1e3 * SCAN_GB / 4:.3g} MB a scan" in text
    assert f"(full frames: {2 * SCAN_GB:.1f} GB)" in text
    text = plan("simulated_rig", **given, full_frames="true").notices[0]
    assert text.startswith("recorder: records full frames into")
    assert f"about {SCAN_GB:.1f} GB a scan" in text


def test_a_disk_that_is_too_small_is_told_first(tmp_path: Path) -> None:
    found = plan("simulated_rig", record=tmp_path / "bag", scans=10_000_000).notices
    assert len(found) == 2
    assert "warning: only" in found[1]


def test_what_only_the_driver_knows_is_said(tmp_path: Path) -> None:
    real = {f"camera_{n}": "x" for n in (1, 2, 3, 4)}
    given = {**real, "sample": "paint", "calibration": CALIBRATION_FILE, "record": tmp_path / "bag"}
    text = plan("rig", **given).notices[0]
    assert "and what camera_1, camera_2, camera_3, camera_4 will send of a whole sensor" in text
    text = plan("rig", **given, region="[0,0,640,480]").notices[0]
    assert "whole sensor" not in text


def test_a_bag_that_exists_is_refused_with_file_and_line(tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    with pytest.raises(LaunchError, match=r"pipeline\.yaml:\d+: node recorder: .*exists already"):
        plan("simulated_rig", record=tmp_path / "bag")


def test_given_says_whether_an_argument_has_a_value(tmp_path: Path) -> None:
    path = tmp_path / "given.yaml"
    path.write_text(
        "arguments:\n  record: {default: ''}\nnodes:\n  - {name: one, node: sequencer}\n"
        "  - {name: two, node: recorder, when: $(given record)}\n"
    )
    for record, expected in (("", ["one"]), ("out/bag", ["one", "two"])):
        found = load_launch_file(path, {"record": record} if record else {}, RUN)
        assert [node.name for node in found.nodes] == expected
    path.write_text("nodes:\n  - {name: two, node: recorder, when: $(given recrod)}\n")
    with pytest.raises(LaunchError, match=r"given\.yaml:2: no argument 'recrod'"):
        load_launch_file(path, {}, RUN)


# -- joining a run from outside


@pytest.fixture
def going_on(run: Run) -> Run:
    run.ready()
    return run


@contextlib.contextmanager
def recorder_of(run: Run, *words: str) -> Iterator[subprocess.Popen[str]]:
    """Start ``tvbrdf bag record``; whatever happens, it ends."""
    process = run.popen("bag", "record", *words, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    with process:
        try:
            yield process
        finally:
            process.kill()


def has_messages(bag: Path) -> bool:
    """Return whether some have been written; attachments alone are 10 kB at most."""
    files = [bag] if bag.suffix else list(bag.glob("*.mcap"))
    return any(path.exists() and path.stat().st_size > 12_000 for path in files)


def sequences(bag: Path, topic: str) -> list[int]:
    with BagReader(bag) as reader:
        return [each.envelope.header.sequence for each in reader.messages(topics=[topic])]


@pytest.mark.system
def test_it_records_until_ctrl_c(going_on: Run) -> None:
    bag = going_on.folder / "bag"
    with recorder_of(going_on, "-o", str(bag)) as process:
        assert process.stdout is not None
        assert "topics into" in process.stdout.readline()
        # a chunk is written each second: then some messages are safely there
        going_on.wait_for(lambda: has_messages(bag), "messages in the bag")
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=20)
    assert (process.returncode, errors) == (0, "")
    numbers = sequences(bag, "/arm/state")
    assert len(numbers) > 10
    lost = numbers[-1] - numbers[0] + 1 - len(numbers)
    row = next(line.split() for line in output.splitlines() if line.startswith("/arm/state"))
    assert row == ["/arm/state", str(len(numbers)), str(lost)]
    with BagReader(bag) as reader:
        graph = read_graph(next(iter(going_on.runtime.glob("tvbrdf/latest"))))
        assert str(graph.utc_ns) in reader.about.run
        assert {"launch/test.yaml", "launch/graph.json"} <= reader.attachments().keys()
        assert reader.start_ns > graph.utc_ns  # on the run's clock


@pytest.mark.system
def test_topics_json_and_the_end_of_the_run(going_on: Run) -> None:
    bag = going_on.folder / "some.mcap"
    with recorder_of(going_on, "-o", str(bag), "-e", "^/(diag|arm)", "--json") as process:
        going_on.wait_for(lambda: has_messages(bag), "messages in the bag")
        going_on.signal()
        output, _ = process.communicate(timeout=30)
    assert process.returncode == 0
    found = json.loads(output)
    counted = {row["topic"]: row["messages"] for row in found["topics"]}
    assert counted == {name: len(sequences(bag, name)) for name in ("/arm/state", "/diagnostics")}
    assert found["files"] == [str(bag)]


@pytest.mark.system
def test_a_full_disk_ends_it_and_keeps_what_there_is(going_on: Run) -> None:
    bag = going_on.folder / "bag.mcap"
    with recorder_of(going_on, "-o", str(bag)) as process:
        going_on.wait_for(lambda: has_messages(bag), "messages in the bag")
        limit = bag.stat().st_size + 1000
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (limit, limit))
        output, errors = process.communicate(timeout=30)
    assert process.returncode == 1
    assert errors.startswith(f"tvbrdf: error: {bag}: can't be written: File too large")
    assert errors.count("\n") == 1
    assert f"{bag}: " in output  # the summary comes all the same
    recover(bag, going_on.folder / "saved.mcap")
    assert len(sequences(going_on.folder / "saved.mcap", "/arm/state")) > 10


@pytest.mark.system
def test_what_can_not_be_recorded_is_told(going_on: Run) -> None:
    exists = going_on.folder / "there"
    exists.mkdir()
    for words, text in (
        (["-o", str(exists)], f"{exists}: exists already; choose another name or remove it"),
        (["--topics", "/arm/stat"], "nobody gives '/arm/stat' in this run; did you mean"),
        (["-e", "nothing"], "no topic of this run is meant; see tvbrdf topic list"),
        (["-e", "("], "is no regular expression"),
        (["--floor-free-mb", "1e8"], "less than the floor"),
    ):
        result = going_on.tvbrdf("bag", "record", *words)
        assert result.returncode == 1
        assert text in result.stderr
        assert result.stderr.startswith("tvbrdf: error: ")
        assert result.stderr.count("\n") == 1


@pytest.mark.system
def test_a_recorder_that_dies_again_and_again_ends_no_run(run: Run) -> None:
    """It is started three times anew; then the run goes on without it."""
    folder = run.launch(STILL_RIG.replace("PATH", str(run.folder / "bag")))
    graph = read_graph(folder)
    lives = 4
    with Watcher(graph, ["/diagnostics"]) as watcher:
        for life in range(1, lives + 1):

            def works(life: int = life) -> bool:
                arrival = watcher.receive(0.1)
                record = run.table(folder)["nodes"]["recorder"]
                message: Any = arrival.envelope.message if arrival is not None else None
                return (
                    record["incarnations"] == life
                    and message is not None
                    and (message.node, message.state) == ("recorder", "running")
                    and bool(message.counters["bag_messages"])
                )

            run.wait_for(works, f"life {life} of the recorder")
            assert read_processes(folder).nodes["recorder"].send(signal.SIGKILL)
    run.wait_text("after 3 restarts; the run goes on without it")
    with Watcher(graph, ["/arm/state"]) as watcher:
        assert watcher.receive(run.limit_s) is not None
    run.signal()
    assert run.wait() == 130
    bags = sorted(path.name for path in run.folder.glob("bag*"))
    assert bags == ["bag", "bag_2", "bag_3", "bag_4"]
    assert run.text().count("was cut off; save it with: tvbrdf bag recover") == lives
