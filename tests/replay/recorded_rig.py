"""Records the simulated rig, run inside one process, as a bag.

The arm is reached over a pseudo-terminal, whose delays are real: two bags of a scene differ a
little. What live nodes found is in the bag too (``/scan/radiance``, ``/scan/parameters``). Nothing
in it names this machine: the run begins at a fixed time, and lives of nodes are named after them.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import yaml

from tvbrdf_launch.find_files import find_launch_file
from tvbrdf_launch.launch_file import load_launch_file
from tvbrdf_launch.plan import make_plan
from tvbrdf_launch.refit.bag_source import GRAPH_ATTACHMENT
from tvbrdf_messages.bag import About, BagWriter
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import Parameters
from tvbrdf_messages.run_directory import Graph
from tvbrdf_messages.topics import find_topic
from tvbrdf_nodes.core.inprocess import InProcessGraph

START_NS = 1_800_000_000_000_000_000
SWEEP_S = 12.0
LIMIT_S = 900.0
STEP_NS = 1_000_000
"""Between messages, where only their order matters."""
Write = Callable[[Envelope, int], None]


def simulated_graph(folder: Path, arguments: Mapping[str, Any]) -> Graph:
    """Return the graph of the shipped simulated rig, its clock at a fixed time."""
    words = {
        name: value
        if isinstance(value, str)
        else str(value)
        if isinstance(value, Path)
        else yaml.safe_dump(value).split("\n...")[0].strip()
        for name, value in arguments.items()
    }
    launch = load_launch_file(find_launch_file("simulated_rig"), words, folder)
    return replace(make_plan(launch, folder).graph, utc_ns=START_NS, monotonic_ns=0)


def run_rig(graph: Graph, write: Write) -> None:
    """Run a rig to its end, and hand over each message of a recorded topic with its time."""
    with InProcessGraph(graph) as rig:
        sequencer = rig.runners["sequencer"]

        def done() -> bool:
            for envelope in rig.bus.taps:
                if find_topic(envelope.topic).recorded:
                    write(anonymous(envelope), rig.clock.now_ns())
            rig.bus.taps.clear()
            return sequencer.exit is not None

        rig.run_until(done, LIMIT_S)
    done()


def anonymous(envelope: Envelope) -> Envelope:
    """Return a message without what tells this run of the same scene from another."""
    header = envelope.header
    header = header._replace(incarnation=f"life_{header.publisher}", host="rig", boot_id="boot")
    message: Any = envelope.message
    if isinstance(message, Parameters):
        message = replace(message, solve_time_ms=0.0)
    return envelope._replace(header=header, message=message)


def attachments(graph: Graph) -> dict[str, bytes]:
    """Return what a bag of a run has inside: the graph, without this machine's paths, and more."""
    calibration = Path(graph.find("hdr_merger").parameters["calibration"])
    plain = asdict(replace(graph, directory=""))
    for each in plain["participants"]:
        for name, value in each["parameters"].items():
            if isinstance(value, str) and value.startswith("/"):
                each["parameters"][name] = Path(value).name
        each["parameters"].pop("driver_parameters", None)
    return {
        GRAPH_ATTACHMENT: json.dumps(plain, sort_keys=True).encode(),
        f"calibration/{calibration.name}": calibration.read_bytes(),
    }


def about() -> About:
    """Return where such a bag comes from: the same each time."""
    return About(
        run="simulated", host="rig", created_ns=START_NS, version="0", recording="simulated"
    )


def record_rig(folder: Path, *, topics: Iterable[str] | None = None, **arguments: Any) -> Path:
    """Run the rig and record it; return the bag.

    Parameters
    ----------
    folder
        Gets ``rig.mcap``.
    topics
        Only these; None: all that are recorded.
    arguments
        Of the launch file; ``pixels`` stands for width and height.
    """
    folder.mkdir(parents=True, exist_ok=True)
    pixels = arguments.pop("pixels", 32)
    chosen = {"width": pixels, "height": pixels, "warm_up_s": 1, "sweep_s": SWEEP_S, **arguments}
    wanted = None if topics is None else frozenset(topics)
    path = folder / "rig.mcap"
    # the path of a Unix socket has at most 107 characters
    with tempfile.TemporaryDirectory(prefix="tv") as place:
        graph = simulated_graph(Path(place), {**chosen, "database": f"{place}/db"})
        with BagWriter(path, about=about(), attachments=attachments(graph)) as bag:

            def write(envelope: Envelope, log_time_ns: int) -> None:
                if wanted is None or envelope.topic in wanted:
                    bag.write_envelope(envelope, log_time_ns)

            run_rig(graph, write)
    return path


def write_bag(
    path: Path, envelopes: Iterable[Envelope], inside: Mapping[str, bytes], **options: Any
) -> Path:
    """Write messages in the order in which they are given."""
    with BagWriter(path, about=about(), attachments=dict(inside), **options) as bag:
        for number, envelope in enumerate(envelopes):
            bag.write_envelope(envelope, START_NS + number * STEP_NS)
    return path


def read_all(path: Path) -> Iterator[Envelope]:
    """Yield a bag's messages in order."""
    from tvbrdf_messages.bag import BagReader

    with BagReader(path) as bag:
        for _, envelope in bag.messages():
            yield envelope
