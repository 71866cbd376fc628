"""The launcher's process of a test: carries out a plan of which the test plays a part.

``python -m tvbrdf_launch.testing.child SPEC DESCRIPTOR``: writes a byte to the descriptor once the
run's directory is there, and stops the run when its standard input ends: the test is gone.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from pathlib import Path

from ..display import Display
from ..launcher import Launcher
from ..plan import Plan
from ..run_folder import RunFolder
from .plans import make_run_plan, watched


class _ToldFolder(RunFolder):
    """A run's directory that tells when it is there."""

    def __init__(self, path: Path, descriptor: int) -> None:
        super().__init__(path)
        self._descriptor = descriptor

    def make(self, plan: Plan) -> None:
        """See :class:`~tvbrdf_launch.run_folder.RunFolder`."""
        super().make(plan)
        os.write(self._descriptor, b"!")
        os.close(self._descriptor)


def main() -> int:
    """Run what the specification says, to its end."""
    spec, descriptor = json.loads(Path(sys.argv[1]).read_text()), int(sys.argv[2])
    keep_frames = spec.pop("keep_frames")
    planned = make_run_plan(**spec)
    graph = watched(planned.plan.graph, keep_frames=keep_frames)
    plan = Plan(planned.plan.launch, graph, planned.plan.nodes, planned.plan.notices)
    folder = _ToldFolder(Path(graph.directory), descriptor)
    threading.Thread(target=_watch_test, daemon=True).start()
    return Launcher(plan, folder, lambda: Display(graph.simulated)).run()


def _watch_test() -> None:
    while os.read(0, 64):
        pass
    os.kill(os.getpid(), signal.SIGINT)


if __name__ == "__main__":
    sys.exit(main())
