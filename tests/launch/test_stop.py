"""``tvbrdf stop``, and the progress bar on a terminal."""

from __future__ import annotations

import os
import pty
import signal
import time
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from tests.launch.conftest import Run

pytestmark = pytest.mark.system


def good(run: Run, *words: str) -> str:
    result = run.tvbrdf(*words)
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    return result.stdout


# -- stop


def test_stop_tells_the_arm_first_and_waits(run: Run) -> None:
    folder = run.ready()
    text = good(run, "stop")
    assert "arm: told to stop and to switch the light off" in text
    events = [(node, what) for node, what, *_ in run.events(folder)]
    assert events.index(("arm", "signal")) < events.index(("arm", "stop"))
    assert run.processes() == []
    assert run.wait() == 130


def test_stop_kills_an_arm_node_that_does_not_react(run: Run) -> None:
    folder = run.ready()
    pid = run.table(folder)["nodes"]["arm"]["pid"]
    os.kill(pid, signal.SIGSTOP)
    began = time.monotonic()
    text = good(run, "stop")
    assert "arm does not react; killed it" in text
    # what the arm has to react, then the others one after another: none hangs
    assert time.monotonic() - began < 10
    assert run.processes() == []


def test_stop_works_when_the_launcher_is_gone(run: Run) -> None:
    run.ready(run.rig.replace("gives: [/arm/state]", "gives: [/arm/state], hang_in_stop: true"))
    run.signal(signal.SIGKILL)
    run.wait()
    good(run, "stop")
    assert run.processes() == []


def test_stop_tells_what_it_could_not_stop(run: Run) -> None:
    folder = run.ready()
    assert run.process is not None
    run.signal(signal.SIGSTOP)  # a launcher that hangs
    result = run.tvbrdf("stop", "--timeout", "0.5")
    assert result.returncode == 1
    assert f"launcher (pid {run.process.pid})" in result.stderr
    run.signal(signal.SIGCONT)
    assert run.wait() == 130
    assert run.table(folder)["state"] == "ended"


# -- the terminal


def test_the_progress_bar_on_a_terminal(run: Run) -> None:
    path = run.write(
        """\
        nodes:
          - name: one
            node: launch_test_nodes:Probe
            parameters: {gives: [/scan/status, /scan/parameters], exit_after_s: 1.0}
            on_exit: shutdown
        """
    )
    here, there = pty.openpty()
    run.environment |= {"TERM": "xterm", "COLUMNS": "120"}
    run.process = run.popen("launch", str(path), stdin=there, stdout=there, stderr=there)
    os.close(there)
    shown = b""
    try:
        while chunk := os.read(here, 65536):
            shown += chunk
    except OSError:  # the other side of a pseudo-terminal was closed
        pass
    os.close(here)
    assert run.wait() == 0
    text = shown.decode()
    assert "━" in text
    assert "25 %" in text
    assert "1:30 left" in text
    assert "Kd_b 0.1235 ± 0.0012" in text
    assert "one has finished" in text
    assert "Traceback" not in text
