"""Memory does not grow with the bag: a fixed limit for a bag many times as large."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.paths import ROOT

BAG_BYTES, LIMIT_BYTES = 200_000_000, 60_000_000
WRITE = """
import sys, numpy as np
from dataclasses import replace
from tests.messages.bag_samples import frame
from tests.sample_messages import START_NS
from tvbrdf_messages.bag import BagWriter
told = [frame(k, START_NS, shape=(400, 417)) for k in range(2)]
with BagWriter(sys.argv[1], compression="none", attachments={"calibration.yaml": b"x"}) as writer:
    for k in range(200):
        envelope = told[k % 2].envelope
        now_ns = START_NS + k * 8_000_000
        header = envelope.header._replace(sequence=k, stamp_ns=now_ns)
        writer.write_envelope(envelope._replace(header=header), now_ns)
"""
USE = """
import sys
from pathlib import Path
from tvbrdf_messages.bag import BagReader, check_bag, recover
import numpy, tvbrdf_messages.codec

def peak():
    text = Path("/proc/self/status").read_text()
    return int(text.split("VmHWM:")[1].split()[0]) * 1024

before = peak()
verb, path = sys.argv[1], sys.argv[2]
if verb == "read":
    with BagReader(path) as reader:
        assert sum(int(e.message.image[0, 0, 0]) >= 0 for _, e in reader.messages()) == 200
elif verb == "check":
    assert check_bag(path).ok
else:
    assert recover(path, path + ".out.mcap").messages == 200
print(peak() - before)
"""


def python(code: str, *words: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("large") / "a.mcap"
    python(WRITE, str(path))
    assert path.stat().st_size > BAG_BYTES
    return path


@pytest.mark.system
@pytest.mark.skipif(sys.platform != "linux", reason="the peak of memory is read from /proc")
@pytest.mark.parametrize("verb", ["read", "check", "recover"])
def test_memory_is_a_few_chunks(bag: Path, verb: str) -> None:
    """200 MB of images in chunks of 4 MiB: 60 MB at most beyond what the imports take."""
    assert int(python(USE, verb, str(bag))) < LIMIT_BYTES
