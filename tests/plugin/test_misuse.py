"""What is not there is named, with a list of what is."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.plugin.probes import Counter, Ticker
from tvbrdf_launch.testing.bags import BagFactory
from tvbrdf_launch.testing.errors import MisuseError
from tvbrdf_launch.testing.graphs import GraphFactory
from tvbrdf_launch.testing.rigs import RigFactory
from tvbrdf_messages.errors import MessageError
from tvbrdf_messages.messages import Clock, Mark

DROP = {"kind": "drop"}
Call = Callable[[Any], object]


@pytest.mark.parametrize(
    ("call", "name", "known"),
    [
        (lambda rig: rig("simulated_rog"), "simulated_rog", "replay, rig, simulated_rig"),
        (lambda rig: rig("nowhere/rig.yaml"), "nowhere/rig.yaml", "replay, rig, simulated_rig"),
        (lambda rig: rig(scan=1), "'scan'", "sample, scans, seed"),
        (lambda rig: rig(scans="many"), "'many'", "expected int"),
        (lambda rig: rig(nodes=["merger"]), "'merger'", "fitter, hdr_merger, sequencer"),
        (lambda rig: rig(without="camera_5"), "'camera_5'", "camera_4, database_writer"),
        (lambda rig: rig(nodes=[]), "no node runs", "world, arm_controller, arm, camera_1"),
        (lambda rig: rig(parameters={"merger": {}}), "'merger'", "fitter, hdr_merger"),
        (
            lambda rig: rig(parameters={"fitter": {"modle": "x"}}),
            "unknown parameter 'modle'",
            "did you mean 'model'",
        ),
        (lambda rig: rig(faults={"camera_5": [DROP]}), "'camera_5'", "arm, camera, camera_1"),
        (lambda rig: rig(faults={"arm": [DROP]}), "drop", "garbage, wrong_checksum, lost_bytes"),
        (lambda rig: rig(faults={"camera": [{"kind": "fall"}]}), "'fall'", "drop, repeat, reorder"),
        (lambda rig: rig(effects="dirty"), "'dirty'", "ideal, realistic"),
        (lambda rig: rig("play", bag="x", faults={"arm": []}), "play", "has no effects"),
    ],
)
def test_of_a_rig(rig: RigFactory, call: Call, name: str, known: str) -> None:
    with pytest.raises(MisuseError, match=re.escape(name)) as caught:
        call(rig)
    assert known in str(caught.value)


def test_real_devices_are_not_started(rig: RigFactory) -> None:
    cameras: dict[str, Any] = {f"camera_{k}": str(k) for k in range(1, 5)}
    calibration = Path(__file__).parents[2] / "launch" / "calibration.yaml"
    with pytest.raises(MisuseError, match=r"arm drives a real device .*SerialArm"):
        rig("rig", sample="s", calibration=calibration, **cameras)


@pytest.mark.parametrize(
    ("call", "name", "known"),
    [
        (lambda graph: graph(), "no node", "fitter, database_writer"),
        (lambda graph: graph("filter"), "'filter'", "fitter, database_writer"),
        (lambda graph: graph("nowhere:Node"), "nowhere:Node", "can't import nowhere"),
        (lambda graph: graph("pathlib:Path"), "pathlib:Path is no node", "derive from Node"),
        (lambda graph: graph((Ticker, {"tick": 1})), "parameter 'tick'", "did you mean 'ticks'"),
        (lambda graph: graph((Ticker, {"ticks": "1"})), "node ticker", "expected int"),
        (lambda graph: graph(Ticker, ticker=Ticker), "two nodes are called ticker", "other_name"),
        (lambda graph: graph(test=Ticker), "two nodes are called test", "other_name"),
        (lambda graph: graph(Ticker, inputs=["/scan/stord"]), "/scan/stord", "/scan/stored"),
    ],
)
def test_of_a_graph(graph: GraphFactory, call: Call, name: str, known: str) -> None:
    with pytest.raises(MisuseError, match=re.escape(name)) as caught:
        call(graph)
    assert known in str(caught.value)


def test_a_class_that_can_not_be_found_again(graph: GraphFactory) -> None:
    class Local(Ticker):
        pass

    with pytest.raises(MisuseError, match="define it at the top of its module"):
        graph(Local)


@pytest.mark.parametrize(
    ("call", "name", "known"),
    [
        (lambda run: run.wait_for("/scan/marks"), "'/scan/marks'", "/log, /operator/mark"),
        (lambda run: run.published("/arm/state"), "/arm/state", "/log, /operator/mark"),
        (lambda run: run.wait_for("/log", count=0), "count is 0", "1 or more"),
        (lambda run: run.send("/scan/marks", Mark(text="")), "'/scan/marks'", "/operator/mark"),
        (lambda run: run.send("/log", Mark(text="")), "can't send /log", "test gives /operator"),
        (
            lambda run: run.send("/operator/mark", Mark(text=""), by="counter"),
            "'counter'",
            "there are: test",
        ),
        (lambda run: run.node("ticker"), "'ticker'", "counter"),
        (lambda run: run.kill("counter"), "'counter'", "test"),
        (lambda run: run.database, "no database_writer", "counter"),
    ],
)
def test_of_a_run(graph: GraphFactory, call: Call, name: str, known: str) -> None:
    run = graph(Counter)
    with pytest.raises(MisuseError, match=re.escape(name)) as caught:
        call(run)
    assert known in str(caught.value)
    with pytest.raises(MessageError, match="/operator/mark carries Mark, not Clock"):
        run.send("/operator/mark", Clock(now_ns=1))


def test_of_a_bag(bag: BagFactory, graph: GraphFactory, tmp_path: Path) -> None:
    recorded = bag([("/operator/mark", Mark(text="1"))], "one.mcap")
    with pytest.raises(MisuseError, match=r"bag 'two\.mcap' does not exist.*: one\.mcap"):
        bag("two.mcap")
    with pytest.raises(MisuseError, match=r"one\.mcap is there already"):
        bag([], "one.mcap")
    with pytest.raises(MisuseError, match=r"topic of one\.mcap '/log'.*: /operator/mark"):
        recorded.messages("/log")
    with pytest.raises(MisuseError, match=r"node player: .*nowhere"):
        graph("fitter", player=("player", {"bag": str(tmp_path / "nowhere.mcap")}))
