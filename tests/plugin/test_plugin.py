"""The plugin as pytest sees it: cheap, overridable, parallel, and clean after failing tests."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytest_plugins = ("pytester",)
HEAVY = ("numpy", "zmq", "yaml", "msgpack", "mcap", "tvbrdf_nodes", "tvbrdf_messages")

USES = """
    from pathlib import Path
    from tvbrdf_messages.messages import Mark
    from tvbrdf_nodes.core.node import Node, TopicUse

    class Device(Node):
        @classmethod
        def topics(cls, name, parameters):
            return TopicUse(takes=("/operator/mark",), gives=("/log",))

        def start(self):
            self.file = Path("device.txt").open("w")
            return ()

        def stop(self):
            self.file.write("off")
            self.file.close()
            return ()

    def test_it(graph):
        run = graph(Device)
        Path("directory.txt").write_text(run.graph.directory)
        {}
"""


def test_loading_it_loads_pytest_and_nothing_else() -> None:
    code = (
        "import sys, pytest; before = set(sys.modules); import tvbrdf_launch.testing.plugin;"
        "print(*sorted(set(sys.modules) - before))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    loaded = done.stdout.split()
    assert [name for name in loaded if name.startswith("tvbrdf")] == [
        "tvbrdf_launch",
        "tvbrdf_launch.testing",
        "tvbrdf_launch.testing.plugin",
    ]
    assert not {name.partition(".")[0] for name in loaded} & set(HEAVY)


@pytest.mark.parametrize(
    ("body", "outcome"),
    [
        ("pass", {"passed": 1}),
        ("assert run is None", {"failed": 1}),
        ("run.wait_for('/log')", {"failed": 1}),
        ("raise KeyboardInterrupt", {}),
    ],
)
def test_all_is_stopped_however_a_test_ends(
    pytester: pytest.Pytester, body: str, outcome: dict[str, int]
) -> None:
    pytester.makepyfile(test_user=USES.replace("{}", body))
    result = pytester.runpytest_subprocess("-W", "error", timeout=60)
    if outcome:
        result.assert_outcomes(**outcome)
    else:
        assert result.ret == pytest.ExitCode.INTERRUPTED
    assert (pytester.path / "device.txt").read_text() == "off"
    assert not Path((pytester.path / "directory.txt").read_text()).exists()
    assert "ResourceWarning" not in result.stdout.str() + result.stderr.str()


def test_a_failing_wait_is_told_in_the_report(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(test_user=USES.replace("{}", "run.wait_for('/log')"))
    result = pytester.runpytest_subprocess(timeout=60)
    result.stdout.fnmatch_lines(
        [
            "*WaitError: waited in vain for a message on /log (0 of 1 came): nothing is left *",
            "*published in all: nothing*",
            "*nodes: device running; test played by the test*",
        ]
    )


def test_a_projects_own_fixtures_win(pytester: pytest.Pytester) -> None:
    pytester.makeconftest("""
        import pytest

        @pytest.fixture
        def rig():
            return "mine"
    """)
    pytester.makepyfile("""
        from tvbrdf_launch.testing.rigs import RigFactory

        def test_both(rig, tvbrdf_rig):
            assert rig == "mine"
            assert isinstance(tvbrdf_rig, RigFactory)
    """)
    pytester.runpytest_subprocess("-W", "error", timeout=60).assert_outcomes(passed=1)


def test_it_can_be_switched_off(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("def test_it(rig): pass")
    result = pytester.runpytest_subprocess("-p", "no:tvbrdf", timeout=60)
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*fixture 'rig' not found*"])


def test_tests_run_beside_each_other(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("""
        import pytest
        from tvbrdf_messages.messages import Mark

        @pytest.mark.parametrize("number", range(6))
        def test_bag(bag, graph, number):
            recorded = bag([("/operator/mark", Mark(text=str(number)))])
            run = graph(player=recorded.player(topics=["/operator/mark"]))
            assert run.wait_for("/operator/mark").text == str(number)
    """)
    result = pytester.runpytest_subprocess("-W", "error", "-n", "2", timeout=120)
    result.assert_outcomes(passed=6)
