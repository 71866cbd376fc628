"""The launcher with real processes: start, restart, ordered stop, and no orphan ever."""

from __future__ import annotations

import json
import os
import random
import signal
import stat
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from tests.launch.conftest import Run

pytestmark = pytest.mark.system

PAIR = """\
nodes:
  - name: source
    node: launch_test_nodes:Probe
    parameters: {gives: [/operator/mark]}
    restart: {policy: on_failure, delay_s: 0.05}
  - name: reader
    node: launch_test_nodes:Probe
    parameters: {takes: [/operator/mark]}
    restart: {policy: on_failure, delay_s: 0.05, max_restarts: 2}
"""
CHAIN = """\
nodes:
  - {name: writer, node: "launch_test_nodes:Probe", parameters: {takes: [/scan/parameters]}}
  - name: fitter
    node: launch_test_nodes:Probe
    parameters: {takes: [/arm/state], gives: [/scan/parameters]}
  - name: arm
    node: launch_test_nodes:Probe
    parameters: {gives: [/arm/state]}
"""


def times(run: Run, folder: Path, event: str) -> dict[str, int]:
    return {node: at for node, what, _, at in run.events(folder) if what == event}


def test_all_start_behind_the_barrier_and_one_ends_the_run(run: Run) -> None:
    folder = run.launch(
        CHAIN.replace("gives: [/arm/state]", "gives: [/arm/state], exit_after_s: 0.2")
        + "    on_exit: shutdown\n"
    )
    assert run.wait() == 0
    began, constructed = times(run, folder, "start"), times(run, folder, "init")
    assert set(began) == {"writer", "fitter", "arm"}
    # nothing moves until every reader has registered, which it does after it was constructed
    assert began["arm"] > constructed["fitter"]
    assert began["fitter"] > constructed["writer"]
    table = run.table(folder)
    assert (table["state"], table["exit_code"]) == ("ended", 0)
    assert {name: n["exit_code"] for name, n in table["nodes"].items()} == dict.fromkeys(began, 0)
    assert "arm has finished" in run.text()
    run.expect_no_process()


def test_the_run_directory_is_private_and_tells_all(run: Run) -> None:
    folder = run.launch(PAIR)
    run.wait_event(folder, "reader", "first:source")
    for path in (folder, folder.parent):
        assert stat.S_IMODE(path.stat().st_mode) == 0o700
    assert (folder.parent / "latest").resolve() == folder
    assert (folder / "launch" / "test.yaml").read_text() == PAIR
    record = json.loads((folder / "launch.json").read_text())
    assert record["arguments"] == {}
    assert record["file"].endswith("test.yaml")
    graph = json.loads((folder / "graph.json").read_text())
    assert graph["utc_ns"] - graph["monotonic_ns"] > 0
    for name in ("source", "reader"):
        pid = run.table(folder)["nodes"][name]["pid"]
        assert os.getsid(pid) == pid, "a node is a session of its own"
        variables = Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
        threads = {b"OMP_NUM_THREADS=1", b"OPENBLAS_NUM_THREADS=1", b"MKL_NUM_THREADS=1"}
        assert threads | {b"PYTHONUNBUFFERED=1"} <= set(variables)
        assert Path(f"/proc/{pid}/fd/0").readlink().name.startswith("pipe:")
        assert (folder / f"{name}.log").exists()
    run.signal()
    assert run.wait() == 130
    assert not [path for path in folder.iterdir() if path.is_socket()]
    run.expect_no_process()


def test_a_killed_node_is_started_again_and_goes_on(run: Run) -> None:
    folder = run.launch(PAIR)
    run.wait_event(folder, "reader", "first:source")
    for times_started in (2, 3):
        pid = run.table(folder)["nodes"]["reader"]["pid"]
        os.kill(pid, signal.SIGKILL)
        run.wait_event(folder, "reader", "first:source", times_started)
        assert run.table(folder)["nodes"]["reader"]["incarnations"] == times_started
    assert len({pid for node, _, pid, _ in run.events(folder) if node == "source"}) == 1
    assert "reader failed (ended by SIGKILL); restart 1 of 2" in run.text()
    # the third time is once too often
    os.kill(run.table(folder)["nodes"]["reader"]["pid"], signal.SIGKILL)
    assert run.wait() == 1
    assert "ended by SIGKILL) after 2 restarts" in run.text()
    run.expect_no_process()


def test_a_node_without_restart_ends_the_run(run: Run) -> None:
    folder = run.launch(CHAIN)
    run.wait_event(folder, "arm", "start")
    os.kill(run.table(folder)["nodes"]["fitter"]["pid"], signal.SIGKILL)
    assert run.wait() == 1
    assert "error: node fitter failed (ended by SIGKILL)" in run.text()
    assert {node for node, what, *_ in run.events(folder) if what == "stop"} == {"arm", "writer"}
    run.expect_no_process()


def test_always_is_started_again_also_after_success(run: Run) -> None:
    folder = run.launch(
        """\
        nodes:
          - name: one
            node: launch_test_nodes:Probe
            parameters: {exit_after_s: 0}
            restart: {policy: always, max_restarts: 2, delay_s: 0}
        """
    )
    assert run.wait() == 1
    assert len(run.wait_event(folder, "one", "exit", 3)) == 3
    assert "node one has ended after 2 restarts" in run.text()


@pytest.mark.parametrize("where", ["init", "prepare", "start"])
def test_a_failure_at_start_quotes_the_log_and_is_not_repeated(run: Run, where: str) -> None:
    folder = run.launch(
        PAIR.replace("takes: [/operator/mark]", f"takes: [/operator/mark], fail_in: {where}")
    )
    assert run.wait() == 1
    text = run.text()
    assert f"told to fail in {where}" in text
    assert f"{folder}/reader.log" in text
    code = 2 if where == "init" else 1
    assert f"tvbrdf: error: node reader failed at start (exit code {code})" in text
    assert len([e for e in run.events(folder) if e[:2] == ("reader", "init")]) == 1
    run.expect_no_process()


def test_the_run_ends_when_all_nodes_have_ended(run: Run) -> None:
    folder = run.launch(
        "nodes:\n  - {name: one, node: 'launch_test_nodes:Probe', parameters: {exit_after_s: 0}}\n"
    )
    assert run.wait() == 0
    assert run.table(folder)["state"] == "ended"


def test_a_node_that_gives_up_ends_the_run_although_it_may_be_restarted(run: Run) -> None:
    folder = run.launch(
        """\
        nodes:
          - name: one
            node: launch_test_nodes:Probe
            parameters: {exit_after_s: 0, exit_code: 1}
            restart: on_failure
            on_exit: shutdown
        """
    )
    assert run.wait() == 1
    assert "node one failed" in run.text()
    assert "told to exit" in run.text()
    assert len([e for e in run.events(folder) if e[1] == "exit"]) == 1


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]
)
def test_signals_stop_in_order(run: Run, number: signal.Signals, code: int) -> None:
    folder = run.launch(CHAIN)
    run.wait_event(folder, "writer", "first:fitter")
    run.signal(number)
    assert run.wait() == code
    stopped = times(run, folder, "stop")
    assert sorted(stopped, key=stopped.__getitem__) == ["arm", "fitter", "writer"]
    assert run.table(folder)["exit_code"] == code
    run.expect_no_process()


def test_a_hanging_node_is_killed_in_the_end(run: Run) -> None:
    folder = run.launch(
        CHAIN.replace("takes: [/arm/state],", "takes: [/arm/state], hang_in_stop: true,")
    )
    run.wait_event(folder, "writer", "first:fitter")
    run.signal()
    run.wait_event(folder, "fitter", "stop")
    run.signal()  # hurry
    assert run.wait() == 130
    assert "fitter does not stop; SIGTERM" in run.text()
    assert "fitter does not stop; SIGKILL" in run.text()
    assert run.table(folder)["nodes"]["fitter"]["exit_code"] == -signal.SIGKILL
    assert "writer" in times(run, folder, "stop")
    run.expect_no_process()


def test_a_third_interrupt_kills_at_once(run: Run) -> None:
    folder = run.launch(
        CHAIN.replace("gives: [/arm/state]", "gives: [/arm/state], hang_in_stop: true")
    )
    run.wait_event(folder, "writer", "first:fitter")
    for said in ("once more: hurry", "once more: kill", "arm does not stop; SIGKILL"):
        run.signal()
        run.wait_text(said)
    assert run.wait(5) == 130
    run.expect_no_process()


def test_what_fails_while_it_stops_fails_the_run(run: Run) -> None:
    run.launch(
        CHAIN.replace(
            "takes: [/scan/parameters]", "takes: [/scan/parameters], fail_in: stop"
        ).replace("gives: [/arm/state]", "gives: [/arm/state], exit_after_s: 0.2")
        + "    on_exit: shutdown\n"
    )
    assert run.wait() == 1
    assert "node writer failed while it stopped (exit code 1)" in run.text()
    assert "told to fail in stop" in run.text()


def test_no_orphan_is_left_when_the_launcher_is_killed(run: Run) -> None:
    folder = run.launch(
        CHAIN.replace("gives: [/arm/state]", "gives: [/arm/state], hang_in_stop: true")
    )
    run.wait_event(folder, "writer", "first:fitter")
    run.signal(signal.SIGKILL)
    assert run.wait() == -signal.SIGKILL
    run.expect_no_process()
    assert {"arm", "fitter", "writer"} == set(times(run, folder, "stop"))


def test_what_a_node_started_goes_with_it(run: Run) -> None:
    folder = run.launch(
        PAIR.replace("gives: [/operator/mark]", "gives: [/operator/mark], child: true")
    )
    run.wait_event(folder, "reader", "first:source")
    assert len(run.processes()) == 4
    os.kill(run.table(folder)["nodes"]["source"]["pid"], signal.SIGKILL)
    run.wait_event(folder, "source", "start", 2)
    assert len(run.processes()) == 4, "the killed node's child is gone too"
    run.signal()
    assert run.wait() == 130
    run.expect_no_process()


@pytest.mark.parametrize("seed", range(6))
def test_an_interrupt_at_any_moment_leaves_nothing(run: Run, seed: int) -> None:
    path = run.write(CHAIN)
    number = (signal.SIGINT, signal.SIGKILL)[seed % 2]
    after_s = random.Random(seed).uniform(0.0, 1.5)
    run.start(str(path))
    assert run.process is not None
    try:
        assert run.process.wait(after_s) is None
    except subprocess.TimeoutExpired:
        run.signal(number)
    assert run.wait() in ((130, -signal.SIGINT) if number == signal.SIGINT else (-number,))
    run.expect_no_process()


def test_a_closed_pipe_does_not_end_the_run(run: Run) -> None:
    path = run.write(CHAIN.replace("gives: [/arm/state]", "gives: [/arm/state], exit_after_s: 0.5")
                     + "    on_exit: shutdown\n")  # fmt: skip
    run.process = run.popen("launch", str(path), stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert run.process.stdout is not None
    assert run.process.stderr is not None
    run.process.stdout.close()
    with run.process.stderr as errors:
        assert run.wait() == 0
        assert errors.read() == ""
    folder = run.wait_for(run.find, "the run")
    assert "arm has finished" in (folder / "launch.log").read_text()


def test_what_people_see(run: Run) -> None:
    run.launch(
        """\
        nodes:
          - name: one
            node: launch_test_nodes:Probe
            parameters: {gives: [/scan/status, /scan/parameters], exit_after_s: 1.0}
            on_exit: shutdown
        """
    )
    assert run.wait() == 0
    text = run.text()
    assert text.count("] scan 1/2, sweep 1/3: sweeping") == 1
    assert "[ 25 %, 1:30 left]" in text
    fitted = [line for line in text.splitlines() if line.startswith("scan 1 (t = 60 s)")]
    assert fitted == [
        "scan 1 (t = 60 s): Kd_b 0.1235 ± 0.0012, sigma_d 0.300 ± 0.020 (at bound); "
        "rms 0.512 %; solved in 12 ms"
    ]


def test_a_directory_in_use_open_or_foreign_is_refused(run: Run) -> None:
    folder = run.launch(PAIR)
    path = str(run.folder / "test.yaml")
    busy = run.tvbrdf("launch", path, "--run", str(folder))
    assert busy.returncode == 1
    assert "a run is going on in" in busy.stderr
    foreign = run.runtime / "foreign"
    foreign.mkdir(mode=0o700)
    (foreign / "thesis.tex").touch()
    refused = run.tvbrdf("launch", path, "--run", str(foreign))
    assert refused.returncode == 1
    assert "holds something that is no run" in refused.stderr
    open_to_all = run.runtime / "open"
    open_to_all.mkdir()
    open_to_all.chmod(0o755)
    refused = run.tvbrdf("launch", path, "--run", str(open_to_all))
    assert refused.returncode == 1
    assert "is open to others" in refused.stderr
    for result in (busy, refused):
        assert len(result.stderr.splitlines()) == 1
    assert list(foreign.iterdir()) == [foreign / "thesis.tex"]
    run.signal()
    run.wait()


def test_a_run_in_a_given_directory_is_the_newest_and_may_be_repeated(run: Run) -> None:
    given = run.runtime / "mine"
    run.environment["TVBRDF_RUN"] = str(given)
    path = run.write(
        "nodes:\n  - {name: one, node: 'launch_test_nodes:Probe', parameters: {exit_after_s: 0}}\n"
    )
    for _ in range(2):
        assert run.tvbrdf("launch", str(path)).returncode == 0
        assert (run.runtime / "tvbrdf" / "latest").resolve() == given.resolve()


def test_old_runs_are_removed_but_never_one_that_goes_on(run: Run) -> None:
    folder = run.launch(PAIR)
    path = run.write(
        "nodes:\n  - {name: one, node: 'launch_test_nodes:Probe', parameters: {exit_after_s: 0}}\n",
        "short.yaml",
    )
    run.environment["TVBRDF_KEEP_RUNS"] = "2"
    for _ in range(3):
        assert run.tvbrdf("launch", str(path)).returncode == 0
    runs = [p for p in (run.runtime / "tvbrdf").iterdir() if not p.is_symlink()]
    assert folder in runs
    assert len(runs) == 3
    run.signal()
    run.wait()


def test_nothing_starts_when_something_is_wrong(run: Run) -> None:
    path = run.write(PAIR.replace("[/operator/mark]}", "[/operator/mrak]}"))
    result = run.tvbrdf("launch", str(path))
    assert result.returncode == 1
    assert result.stderr.startswith(f"tvbrdf: error: {path}:")
    assert "unknown topic" in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert not (run.runtime / "tvbrdf").exists()
