#!/usr/bin/env python3
"""Record a rig, kill its recorder in mid-scan, save the bag, replay it, refit it, and compare.

    python docs/examples/record_kill_recover.py [FOLDER] [key:=value ...]

A simulated rig measures a drying paint three times and is recorded. In the second scan the recorder
is killed with SIGKILL; the launcher starts it again, the measurement takes no notice. What was cut
off is recovered, merged with what the second recorder wrote, checked, replayed through the real
nodes and refitted without them. Each scan that the bag has whole must then have the parameters of
the live run, value by value. The exit status is 1 if any differs.

FOLDER (out/bags) must not exist yet. ``key:=value`` are arguments of ``simulated_rig``, e.g.
``sample:=wet_cloth width:=128 height:=128``. All commands are printed as they run; this takes half
a minute.
"""
# ruff: noqa: T201

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tvbrdf_fitting.published.database import StoredFit, read_database

TVBRDF = (sys.executable, "-m", "tvbrdf_launch")
LIMIT_S = 300.0
"""For each step, on the busiest machine."""
STOP_S = 30.0
SMALL = {
    "scans": "3",
    "interval_s": "400",  # of the rig's time; the script does not wait for it, see `measure`
    "warm_up_s": "2",
    "sweep_s": "4",
    "width": "64",
    "height": "64",
    "speedup": "8",
}
CUT, AFTER = 2, 3
"""The scan in which the recorder is killed, and the one that its successor records."""
EXPECTED_PROBLEMS = frozenset({"gap"})
"""Of ``bag check``: what the killed recorder missed. Anything else would be damage."""


class ExampleError(Exception):
    """Something did not go as it must."""


# -- commands


def tvbrdf(*words: str | Path) -> None:
    """Print a command and run it."""
    text = [str(word) for word in words]
    print(f"\n$ tvbrdf {' '.join(text)}", flush=True)
    if subprocess.run([*TVBRDF, *text], check=False, timeout=LIMIT_S).returncode:
        raise ExampleError(f"tvbrdf {text[0]} failed")


def ask(*words: str | Path) -> Any:
    """Run a command with ``--json``; return what it printed, or None."""
    command = [*TVBRDF, *map(str, words), "--json"]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=LIMIT_S)
    return json.loads(done.stdout) if done.stdout else None


def wait_for(topic: str, wanted: Callable[[dict[str, Any]], bool], what: str) -> None:
    """Return when the run has sent a message that is wanted."""
    command = [*TVBRDF, "topic", "echo", topic, "--json", "--duration", f"{LIMIT_S}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as echo:
        assert echo.stdout is not None
        try:
            if any(wanted(json.loads(line)) for line in echo.stdout):
                return
        finally:
            echo.kill()
    raise ExampleError(f"waited in vain for {what}")


# -- the rig


@contextlib.contextmanager
def rig(log: Path, arguments: Mapping[str, str]) -> Iterator[subprocess.Popen[bytes]]:
    """Give the launcher of a simulated rig, which is stopped at the end whatever happens."""
    words = ["launch", "simulated_rig", *(f"{key}:={value}" for key, value in arguments.items())]
    print(f"$ tvbrdf {' '.join(words)} &   # it prints into {log}", flush=True)
    with log.open("wb") as output:
        launcher = subprocess.Popen(
            [*TVBRDF, *words, "--plain"],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # Ctrl-C reaches this script alone, which then stops the rig
        )
    try:
        yield launcher
    finally:
        if launcher.poll() is None:
            launcher.send_signal(signal.SIGINT)
        try:
            launcher.wait(STOP_S)
        except subprocess.TimeoutExpired:
            launcher.kill()  # its nodes end by themselves then
            launcher.wait()


@contextlib.contextmanager
def said_in(log: Path) -> Iterator[None]:
    """Add to a failure what the rig printed."""
    try:
        yield
    except ExampleError as error:
        raise ExampleError(f"{error}; the rig said:\n{log.read_text()}") from None


def process_of(node: str, launcher: subprocess.Popen[bytes]) -> int:
    """Return the process id of a node as soon as it works."""
    deadline = time.monotonic() + LIMIT_S
    while launcher.poll() is None and time.monotonic() < deadline:
        told = ask("node", "info", node)
        if told and told["state"] == "alive":
            return int(told["pid"])
    raise ExampleError(f"the rig did not start its {node}")


def measure(folder: Path, arguments: Mapping[str, str]) -> None:
    """Measure and record; kill the recorder in mid-scan."""

    def due(scan: int) -> Callable[[dict[str, Any]], bool]:
        return lambda told: (told["state"], told["scan"]) == ("interval", scan)

    def sweeping(told: dict[str, Any]) -> bool:
        return (told["state"], told["scan"], told["sweep"]) == ("sweeping", CUT, 2)

    def recording(told: dict[str, Any]) -> bool:
        works = (told["node"], told["state"]) == ("recorder", "running")
        return works and bool(told["counters"]["recording"])

    log = folder / "launch.txt"
    with rig(log, arguments) as launcher, said_in(log):
        recorder = process_of("recorder", launcher)
        wait_for("/scan/status", due(CUT), f"the end of scan {CUT - 1}")
        tvbrdf("scan")
        wait_for("/scan/status", sweeping, f"a sweep of scan {CUT}")
        print(f"\n$ kill -KILL {recorder}   # the recorder", flush=True)
        os.kill(recorder, signal.SIGKILL)
        wait_for("/diagnostics", recording, "the recorder's return")
        wait_for("/scan/status", due(AFTER), f"the end of scan {CUT}")
        tvbrdf("scan")
        if launcher.wait(LIMIT_S):
            raise ExampleError("the rig failed")
    told = log.read_text().splitlines()
    print("\n".join(line for line in told if line.startswith(("node recorder", "recorder:"))))


def check(bag: Path) -> None:
    """Check a bag that was put together: it may have gaps, and nothing else may be wrong."""
    print(f"\n$ tvbrdf bag check {bag}", flush=True)
    report = ask("bag", "check", bag)
    if report is None:
        raise ExampleError(f"{bag} can't be checked")
    wrong = [each["text"] for each in report["problems"] if each["kind"] not in EXPECTED_PROBLEMS]
    if wrong:
        raise ExampleError("\n".join(wrong))
    gaps = len(report["problems"])
    print(f"{report['messages']} messages, {gaps} gaps that the kill left, nothing else is wrong")


# -- comparing


def fits(database: Path) -> dict[int, StoredFit]:
    """Return the fitted scans of a database's only sample."""
    (sample,) = read_database(database).samples
    return {scan.scan: scan.fit for scan in sample.scans if scan.fit is not None}


def same(one: StoredFit, other: StoredFit, index: int) -> bool:
    """Say whether a parameter, its deviation and its covariances are the same, bit for bit."""
    if (one.model, one.parameter_names) != (other.model, other.parameter_names):
        return False
    return all(
        np.asarray(mine)[index].tobytes() == np.asarray(theirs)[index].tobytes()
        for mine, theirs in (
            (one.values, other.values),
            (one.standard_deviations, other.standard_deviations),
            (one.covariance, other.covariance),
        )
    )


def compare(live: Path, others: Mapping[str, Path], cut: int | None = None) -> bool:
    """Print the live run's parameters beside those of other databases; say if all are the same.

    Parameters
    ----------
    live, others
        Databases.
    cut
        A scan that the others may lack.
    """
    wanted, found = fits(live), {name: fits(path) for name, path in others.items()}
    titles = "".join(f"  {name:9}" for name in others)
    print(f"\nscan  parameter       {'live':20}{titles}".rstrip())
    identical = bool(wanted)
    for number, fit in wanted.items():
        having = [name for name in others if number in found[name]]
        if not having and number == cut:
            print(f"{number:4}  not whole in the bag")
            continue
        for index, parameter in enumerate(fit.parameter_names):
            words = []
            for name in others:
                other = found[name].get(number)
                is_same = other is not None and same(fit, other, index)
                words.append("identical" if is_same else "differs" if other else "missing")
                identical &= is_same
            cells = "".join(f"  {word:9}" for word in words)
            print(f"{number:4}  {parameter:14}  {float(fit.values[index])!r:20}{cells}".rstrip())
    return identical


# -- the whole


def run(folder: Path, given: Mapping[str, str]) -> bool:
    """Do all of it; say whether all whole scans were the same."""
    bag, live, again = folder / "bag", folder / "database", folder / "replayed"
    saved, merged = folder / "saved", folder / "merged"
    measure(folder, {**SMALL, **given, "record": str(bag), "database": str(live)})
    tvbrdf("bag", "recover", bag, "--out", saved)
    tvbrdf("bag", "merge", saved, f"{bag}_2", "--out", merged)
    check(merged)
    tvbrdf("launch", "replay", f"bag:={merged}", f"database:={again}", "--plain")
    tvbrdf("refit", merged, "--out", folder / "refit")
    refitted = folder / "refit" / merged.name / "database"
    return compare(live, {"replay": again, "refit": refitted}, cut=CUT)


def main() -> int:
    """Run the script."""
    usage = "%(prog)s [FOLDER] [key:=value ...]"
    parser = argparse.ArgumentParser(usage=usage, description=__doc__.partition("\n")[0])
    parser.add_argument("words", nargs="*", metavar="key:=value", help="of simulated_rig")
    words: list[str] = parser.parse_args().words
    folder = Path(words.pop(0) if words and ":=" not in words[0] else "out/bags")
    if any(":=" not in word for word in words):
        parser.error("after the folder come arguments like width:=128")
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        parser.error(f"{folder} is there already; remove it, or give another folder")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # not without stopping the rig
    # of its own, so that tools in other terminals do not take these runs for their newest; with a
    # short path, which the runs' sockets need
    runs = Path(tempfile.mkdtemp(prefix="tvbrdf-"))
    os.environ["XDG_RUNTIME_DIR"] = str(runs)
    os.environ.pop("TVBRDF_RUN", None)
    try:
        identical = run(folder, dict(word.split(":=", 1) for word in words))
    except (ExampleError, subprocess.TimeoutExpired) as error:
        print(f"\nfailed: {error}\nthe nodes' logs are in {runs}", file=sys.stderr)
        return 1
    except BaseException:
        shutil.rmtree(runs, ignore_errors=True)
        raise
    shutil.rmtree(runs, ignore_errors=True)
    print(f"\n{'all values are identical' if identical else 'VALUES DIFFER'}")
    return 0 if identical else 1


if __name__ == "__main__":
    sys.exit(main())
