"""The command line: every verb against a run of small nodes, as text and as JSON."""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.paths import CALIBRATION_FILE
from tvbrdf_launch.cli import parser

if TYPE_CHECKING:
    from tests.launch.conftest import Run

pytestmark = pytest.mark.system

CAMERAS = """\
  - {name: camera_1, node: "launch_test_nodes:StillCamera"}
  - name: camera_2
    node: launch_test_nodes:StillCamera
    parameters: {bit_depth: 16, dn_per_ms: 3000}
"""


def verbs() -> list[tuple[str, ...]]:
    """Return the words of every verb there is."""

    def below(one: argparse.ArgumentParser, words: tuple[str, ...]) -> list[tuple[str, ...]]:
        found = [words]
        for action in one._actions:
            if isinstance(action, argparse._SubParsersAction):
                for name, other in action.choices.items():
                    found += below(other, (*words, name))
        return found

    return below(parser(), ())


def good(run: Run, *words: str) -> str:
    result = run.tvbrdf(*words)
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    return result.stdout


def parsed(run: Run, *words: str) -> Any:
    return json.loads(good(run, *words, "--json"))


def bad(run: Run, *words: str) -> str:
    """Return the one line of an error."""
    result = run.tvbrdf(*words)
    assert result.returncode == 1, result.stdout
    assert len(result.stderr.splitlines()) == 1, result.stderr
    assert result.stderr.startswith("tvbrdf: error: ")
    return result.stderr


# -- help


def test_every_verb_has_help(capsys: pytest.CaptureFixture[str]) -> None:
    found = verbs()
    assert len(found) >= 24
    for words in found:
        with pytest.raises(SystemExit) as ended:
            parser().parse_args([*words, "--help"])
        assert ended.value.code == 0
        assert "usage: tvbrdf" in capsys.readouterr().out


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from tvbrdf_launch.cli import parser; parser().format_help();"
        "print([m for m in ('numpy', 'yaml', 'zmq', 'rich', 'msgpack') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("words", [["lanch"], ["launch"], ["arm", "lamp", "dim"], ["topic"],
                                   ["stop", "--timeout", "-1"], ["stop", "x"]])  # fmt: skip
def test_wrong_usage_is_status_2(run: Run, words: list[str]) -> None:
    result = run.tvbrdf(*words)
    assert result.returncode == 2
    assert "Traceback" not in result.stderr


def test_version_and_no_verb(run: Run) -> None:
    assert good(run, "--version").strip()
    assert "verbs:" in good(run)


# -- launch


def test_shipped_launch_files_are_listed_and_others_are_not(run: Run) -> None:
    rows = parsed(run, "launch", "--list")
    names = [row["name"] for row in rows]
    assert {"simulated_rig", "rig"} <= set(names)
    assert "calibration" not in names
    assert all(row["description"] for row in rows)
    assert "simulated_rig" in good(run, "launch", "--list")


def test_arguments_are_shown(run: Run) -> None:
    rows = {row["name"]: row for row in parsed(run, "launch", "simulated_rig", "--show-args")}
    assert rows["sample"]["default"] == "drying_paint"
    assert rows["scans"] == rows["scans"] | {"type": "int", "default": 3}
    text = good(run, "launch", "-s", "simulated_rig")
    assert "'scans' (int):" in text


def test_check_starts_nothing(run: Run) -> None:
    path = str(run.write(run.rig))
    assert "good; 3 nodes: arm, reader, sequencer" in good(run, "launch", path, "--check")
    assert parsed(run, "launch", path, "--check")["nodes"] == ["arm", "reader", "sequencer"]
    assert not (run.runtime / "tvbrdf").exists()


def test_launch_errors_are_one_line(run: Run) -> None:
    assert "did you mean 'simulated_rig'?" in bad(run, "launch", "simulated_rgi")
    assert "no launch file x.yaml" in bad(run, "launch", "x.yaml")
    path = str(run.write(run.rig))
    assert "unknown argument 'scans'" in bad(run, "launch", path, "--check", "scans:=3")
    assert "not of the form key:=value" in bad(run, "launch", path, "scans=3")


# -- topics


def test_topic_list(run: Run) -> None:
    run.ready()
    assert good(run, "topic", "list").split() == [
        "/arm/state",
        "/diagnostics",
        "/log",
        "/scan/command",
    ]
    assert "/arm/state [ArmState]" in good(run, "topic", "list", "-t")
    assert good(run, "topic", "list", "-c").strip() == "4"
    verbose = good(run, "topic", "list", "-v")
    assert "Published topics:" in verbose
    assert " * /arm/state [ArmState] 1 publisher\n" in verbose
    assert " * /diagnostics [Diagnostics] 3 publishers\n" in verbose
    assert " * /arm/state [ArmState] 1 subscriber\n" in verbose
    rows = {row["name"]: row for row in parsed(run, "topic", "list")}
    assert rows["/arm/state"]["publishers"] == ["arm"]
    assert rows["/arm/state"]["quality"] == "lossless"


def test_topic_info(run: Run) -> None:
    run.ready()
    text = good(run, "topic", "info", "/arm/state", "-v")
    assert "Type: ArmState\n" in text
    assert "Publisher count: 1\n  arm\n" in text
    assert "Subscription count: 1\n  reader\n" in text
    assert "  angle_deg: float\n" in text
    found = parsed(run, "topic", "info", "/arm/state")
    assert found["fields"]["homed"] == "bool"
    assert "did you mean '/arm/state'?" in bad(run, "topic", "info", "/arm/stat")


def test_topic_echo(run: Run) -> None:
    run.ready()
    text = good(run, "topic", "echo", "/arm/state", "--once")
    assert text.endswith("---\n")
    assert "speed_deg_s: 15.0\n" in text
    assert "publisher: arm" in text
    assert good(run, "topic", "echo", "/arm/state", "-n", "2", "--field", "lamp") == (
        "true\n---\ntrue\n---\n"
    )
    lines = good(run, "topic", "echo", "/arm/state", "-n", "3", "--json").splitlines()
    sequence = [json.loads(line)["header"]["sequence"] for line in lines]
    assert sequence == sorted(set(sequence))
    assert len(sequence) == 3
    wrong = bad(run, "topic", "echo", "/arm/state", "--field", "header.stamp")
    assert "no field 'stamp' (of header.stamp); did you mean 'stamp_ns'?" in wrong
    assert "0 of 1 messages came on /scan/command" in bad(
        run, "topic", "echo", "/scan/command", "--once", "--duration", "0.3"
    )


def test_topic_hz(run: Run) -> None:
    run.ready()
    last = good(run, "topic", "hz", "/arm/state", "--duration", "2", "--json").splitlines()[-1]
    found = json.loads(last)
    # the probe waits 20 ms between two messages: it can be slower, never faster
    assert 5 < found["rate_hz"] <= 50.5
    assert found["period_s"]["window"] >= 10
    text = good(run, "topic", "hz", "/arm/state", "--duration", "1.5", "--stamps", "-w", "20")
    assert "average rate: " in text
    assert "min: " in text
    assert "no new messages" in good(run, "topic", "hz", "/scan/command", "--duration", "0.2")


def test_topic_bw_and_delay(run: Run) -> None:
    run.ready()
    last = good(run, "topic", "bw", "/arm/state", "--duration", "1.5", "--json").splitlines()[-1]
    found = json.loads(last)
    size, rate = found["message_bytes"]["mean"], found["bytes_per_s"]
    assert 50 < size < 1000
    assert 5 * size < rate <= 50.5 * size
    assert "B/s from" in good(run, "topic", "bw", "/arm/state", "--duration", "1.5")
    last = good(run, "topic", "delay", "/arm/state", "--duration", "1", "--json").splitlines()[-1]
    # one machine, one clock: above 0, and far below what a loaded machine may take
    assert 0 < json.loads(last)["delay_s"]["min"] < 1
    assert "average delay: 0." in good(run, "topic", "delay", "/arm/state", "--duration", "1")


@pytest.mark.parametrize("verb", ["echo", "hz"])
def test_ctrl_c_ends_watching_quietly(run: Run, verb: str) -> None:
    run.ready()
    process = run.popen("topic", verb, "/arm/state", stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline()
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=10)
    assert process.returncode == (130 if verb == "echo" else 0)
    assert errors == ""


def test_a_closed_pipe_is_quiet(run: Run) -> None:
    run.ready()
    process = run.popen(
        "topic", "echo", "/arm/state", stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.readline()
    process.stdout.close()
    with process.stderr as errors:
        assert process.wait(10) == 1
        assert errors.read() == ""


def test_echo_ends_with_the_run(run: Run) -> None:
    run.ready()
    process = run.popen("topic", "echo", "/arm/state", stdout=subprocess.DEVNULL)
    run.signal()
    assert process.wait(15) == 0


# -- nodes


def test_node_list_and_info(run: Run) -> None:
    folder = run.ready()
    assert good(run, "node", "list").split() == ["arm", "reader", "sequencer"]
    assert good(run, "node", "list", "-c").strip() == "3"
    assert "launch_test_nodes:Probe" in good(run, "node", "list", "-v")
    rows = {row["name"]: row for row in parsed(run, "node", "list")}
    assert rows["arm"]["pid"] == run.table(folder)["nodes"]["arm"]["pid"]
    assert (rows["arm"]["state"], rows["arm"]["restarts"]) == ("alive", 0)
    text = good(run, "node", "info", "arm")
    assert "  Publishers:\n    /arm/state: ArmState\n" in text
    assert "Diagnostics: running" in text
    found = parsed(run, "node", "info", "reader")
    assert found["subscribers"] == {"/arm/state": "ArmState"}
    assert found["diagnostics"]["counters"]["received"] > 0
    assert "did you mean 'arm'?" in bad(run, "node", "info", "amr")


def test_an_ended_run_can_still_be_looked_at(run: Run) -> None:
    folder = run.ready()
    run.signal()
    assert run.wait() == 130
    assert {row["state"] for row in parsed(run, "node", "list")} == {"ended"}
    assert parsed(run, "node", "info", "arm")["exit_code"] == 0
    assert "has ended" in bad(run, "mark", "late")
    assert "has already ended" in good(run, "stop")
    assert good(run, "topic", "echo", "/arm/state", "--run", str(folder)) == ""


def test_no_run_is_told(run: Run) -> None:
    for words in (["topic", "list"], ["node", "list"], ["stop"], ["scan"], ["preview"]):
        assert "start one with tvbrdf launch" in bad(run, *words)
    assert "no run directory" in bad(run, "topic", "list", "--run", "/nowhere")
    assert "holds no run" in bad(run, "topic", "list", "--run", str(run.folder))
    assert "holds no run" in bad(run, "stop", "--run", str(run.folder))


# -- what an operator needs


def test_requests_reach_the_sequencer(run: Run) -> None:
    run.ready()
    cases: list[tuple[list[str], str, dict[str, Any]]] = [
        (["arm", "home"], "home", {}),
        (["arm", "jog", "-30.5"], "jog", {"angle_deg": -30.5}),
        (["arm", "stop"], "stop", {}),
        (["arm", "lamp", "on"], "lamp", {"on": True}),
        (["arm", "lamp", "off"], "lamp", {"on": False}),
        (["scan"], "scan", {}),
        (["mark", "paint", "applied"], "mark", {"text": "paint applied", "zero": False}),
        (["mark", "--zero", "wet"], "mark", {"text": "wet", "zero": True}),
    ]
    for words, verb, arguments in cases:
        found = parsed(run, *words)
        assert found == {"ok": True, "text": f"{verb} done", "arguments": arguments}
    assert good(run, "scan") == "scan done\n"
    assert bad(run, "mark", "refuse") == "tvbrdf: error: not this one\n"


def test_no_answer_is_told(run: Run) -> None:
    run.ready(run.rig.replace('Answerer"', 'Answerer", parameters: {silent: true}'))
    assert "has not answered 'scan' within 0.3 s" in bad(run, "scan", "--timeout", "0.3")


def test_preview(run: Run) -> None:
    import cv2
    import OpenEXR

    merger = "  - name: merger\n    node: launch_test_nodes:Merger\n"
    merger += f"    parameters: {{calibration: {CALIBRATION_FILE}}}\n"
    folder = run.ready(run.rig + CAMERAS + merger)
    found = parsed(run, "preview", "--out", "stills")
    assert [(s["camera"], s["exposure_ms"]) for s in found["stills"]] == [
        ("camera_1", 1.0),
        ("camera_1", 10.0),
        ("camera_2", 1.0),
        ("camera_2", 10.0),
    ]
    short, long = found["stills"][:2]
    # the ramp: black level 64, and 400 codes per ms at the bright end of R, a third of it in B
    assert short["maximum"] == {"B": 197.0, "G": 331.0, "R": 464.0}
    assert short["saturated_percent"] == {"B": 0.0, "G": 0.0, "R": 0.0}
    assert long["maximum"]["R"] == 4064.0
    assert sum(long["histogram"]["G"]) == 64 * 48
    # 16 bits: 3000 codes per ms, so R in full light is 30064 at 10 ms: nothing is clipped
    assert found["stills"][3]["maximum"]["R"] == 30064.0
    png: Any = cv2.imread(str(run.folder / "stills" / "camera_1_10ms.png"), cv2.IMREAD_UNCHANGED)
    assert (png.shape, png.dtype) == ((48, 64, 3), np.uint16)
    assert png[0, -1, 2] == round(4064 * 65535 / 4095)
    with OpenEXR.File(str(run.folder / "stills" / "camera_1_radiance.exr")) as file:
        rgb = file.channels()["RGB"].pixels
    assert rgb.shape == (48, 64, 3)
    # radiance = codes per ms · radiance_per_dn_per_ms of calibration.yaml; the codes are whole
    # numbers, at 10 ms half a code of 4000
    bright = 400.0 * 1.6538493e-3 * np.array([3.0, 2.0, 1.0]) / 3
    np.testing.assert_allclose(rgb[:, -1], np.broadcast_to(bright, (48, 3)), rtol=1e-3)
    text = good(run, "preview")
    assert "camera_1         1 ms" in text
    assert "wrote 6 files into out/preview" in text
    assert folder.exists()


def test_preview_tells_what_is_missing(run: Run) -> None:
    run.ready()
    assert "this run has no cameras" in bad(run, "preview")


def test_samples(run: Run) -> None:
    rows = parsed(run, "samples")
    assert {"kind", "name", "description", "file"} <= set(rows[0])
    assert {row["name"] for row in rows if row["kind"] == "effects"} >= {"ideal", "realistic"}
    assert "realistic" in good(run, "samples")


def test_report_needs_a_database(run: Run) -> None:
    assert "not a folder" in bad(run, "report", "nowhere")


def test_doctor(run: Run) -> None:
    result = run.tvbrdf("doctor", "--json")
    rows = json.loads(result.stdout)
    by_name = {row["name"]: row for row in rows}
    assert {"Python", "packages", "run directory", "sockets", "disk", "cores", "Aravis"} <= set(
        by_name
    )
    assert by_name["sockets"]["state"] == "ok"
    assert all(row["advice"] for row in rows if row["state"] != "ok")
    assert result.returncode == (1 if any(row["state"] == "fail" for row in rows) else 0)
    run.environment["TVBRDF_RUN"] = str(run.runtime / ("x" * 100))
    failing = run.tvbrdf("doctor")
    assert failing.returncode == 1
    assert "FAIL  run directory" in failing.stdout
    assert "set TVBRDF_RUN to a short path" in failing.stdout
