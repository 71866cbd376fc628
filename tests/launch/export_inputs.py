"""A bag with frames, radiance, parameters and words, for the tests of exports."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tests.launch.refit_inputs import inside
from tests.messages.bag_samples import header
from tests.replay.process_replay import BAG, RESULTS
from tests.replay.recorded_rig import read_all, write_bag
from tests.sample_messages import START_NS
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import Log, Mark, Radiance, ScanMissing

MISSING = ScanMissing(sample="drying_paint", scan=2, scan_time_s=60.0, reason="lamp failed")


def said(topic: str, message: Any, sequence: int, publisher: str = "sequencer") -> Envelope:
    """Return a message as a node sends it."""
    return Envelope(topic, header(publisher, sequence, START_NS + 5_000_000_000), message)


def words() -> list[Envelope]:
    """Return what is told beside the measurement."""
    return [
        said("/operator/mark", Mark(text="painted", zero=True), 0),
        said("/log", Log(node="arm", level="warning", text="slow answer"), 0, "arm"),
        said("/scan/missing", MISSING, 1),
    ]


def results() -> list[Envelope]:
    """Return what merger and fitter found of the scan in the bag."""
    return [e for e in read_all(RESULTS) if e.topic in {"/scan/radiance", "/scan/parameters"}]


def the_radiance() -> Radiance:
    """Return the scan as the merger published it."""
    (found,) = [e.message for e in results() if isinstance(e.message, Radiance)]
    return found


def whole_bag(
    path: Path,
    keep: Callable[[Envelope], bool] = lambda envelope: True,
    attachments: dict[str, bytes] | None = None,
    more: tuple[Envelope, ...] = (),
) -> Path:
    """Write a bag of a whole scan with its results, or a part of it."""

    def envelopes() -> Iterator[Envelope]:
        for envelope in (*read_all(BAG), *results(), *words(), *more):
            if keep(envelope):
                yield envelope

    return write_bag(path, envelopes(), inside() if attachments is None else attachments)
