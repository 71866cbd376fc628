"""Launch files: what they resolve to, and that every error has its file and line."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import pytest

from tvbrdf_launch.arguments import parse_assignments
from tvbrdf_launch.errors import LaunchError
from tvbrdf_launch.launch_file import LaunchFile, load_declaration, load_launch_file
from tvbrdf_launch.yaml_items import parse_value

RUN = Path("/run/of/this")


def load(folder: Path, text: str, /, **arguments: str) -> LaunchFile:
    path = folder / "rig.yaml"
    path.write_text(textwrap.dedent(text))
    return load_launch_file(path, arguments, RUN)


def parameters(launch: LaunchFile, node: str = "one") -> Any:
    return next(n for n in launch.nodes if n.name == node).parameters.plain()


def test_a_whole_substitution_keeps_its_type_and_others_are_written_out(tmp_path: Path) -> None:
    launch = load(
        tmp_path,
        """\
        arguments:
          scans: {default: 3}
          rate: {default: 1e-3}
          on: {default: true}
          times: {default: [0.2, 4]}
          name: {default: paint}
        nodes:
          - name: one
            node: fitter
            parameters:
              scans: $(var scans)
              rate: $(var rate)
              on: "$(var on)"
              times: $(var times)
              nested: {list: [$(var name), "$(var name)_$(var scans)"]}
              port: $(run)/arm.tty
              file: $(launch_dir)/calibration.yaml
        """,
        scans="5",
    )
    assert parameters(launch) == {
        "scans": 5,
        "rate": 0.001,
        "on": True,
        "times": [0.2, 4],
        "nested": {"list": ["paint", "paint_5"]},
        "port": "/run/of/this/arm.tty",
        "file": f"{tmp_path}/calibration.yaml",
    }
    assert launch.arguments["scans"] == 5


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("on", "on"),
        ("12:30", "12:30"),
        ("1e-3", 1e-3),
        ("-.5", -0.5),
        ("010", 10),
        ("0x10", 16),
        ("0o17", 15),
        ("-.inf", float("-inf")),
        ("~", None),
        ("true", True),
        ("2024-01-01", "2024-01-01"),
        ("'5'", "5"),
        ("[1, {a: b}]", [1, {"a": "b"}]),
    ],
)
def test_plain_values_follow_yaml_1_2(text: str, value: Any) -> None:
    found = parse_value(text, Path("x"))
    assert found == value
    assert type(found) is type(value)


def test_arguments_take_the_type_of_their_default_or_the_declared_one(tmp_path: Path) -> None:
    text = """\
        arguments:
          text: {default: a}
          whole: {default: 1}
          number: {default: 1.5}
          flag: {default: false}
          several: {default: [1]}
          optional: {default: null, type: float}
          free: {default: null}
        nodes: [{name: one, node: fitter}]
    """
    launch = load(
        tmp_path,
        text,
        text="12",
        whole="7",
        number="2",
        flag="true",
        several="[0.2, 4]",
        free="[a]",
    )
    assert launch.arguments == {
        "text": "12",
        "whole": 7,
        "number": 2.0,
        "flag": True,
        "several": [0.2, 4],
        "optional": None,
        "free": "[a]",
    }
    assert type(launch.arguments["number"]) is float


def test_when_leaves_nodes_out(tmp_path: Path) -> None:
    text = """\
        arguments: {record: {default: false}}
        nodes:
          - {name: one, node: fitter}
          - {name: two, node: no_such_node, when: $(var record)}
    """
    assert [n.name for n in load(tmp_path, text).nodes] == ["one"]
    assert [n.name for n in load(tmp_path, text, record="true").nodes] == ["one", "two"]


def test_includes_have_arguments_of_their_own(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "pipeline.yaml").write_text(
        textwrap.dedent("""\
        arguments:
          model: {}
          path: {default: $(launch_dir)/here}
        nodes:
          - name: one
            node: fitter
            parameters: {model: $(var model), path: $(var path)}
        """)
    )
    launch = load(
        tmp_path,
        """\
        arguments: {chosen: {default: dust}}
        include:
          - {file: parts/pipeline.yaml, arguments: {model: $(var chosen)}}
        nodes:
          - {name: two, node: world}
        """,
    )
    assert parameters(launch) == {"model": "dust", "path": f"{tmp_path}/parts/here"}
    assert [n.name for n in launch.nodes] == ["one", "two"]
    assert [f.name for f in launch.files] == ["rig.yaml", "pipeline.yaml"]
    assert launch.nodes[0].place.file == tmp_path / "parts" / "pipeline.yaml"


def test_restart_policies(tmp_path: Path) -> None:
    launch = load(
        tmp_path,
        """\
        nodes:
          - {name: one, node: fitter}
          - {name: two, node: fitter, restart: on_failure}
          - {name: three, node: fitter, restart: {policy: always, max_restarts: 7, delay_s: 2}}
          - {name: four, node: fitter, on_exit: shutdown}
        """,
    )
    policies = [(n.restart.policy, n.restart.max_restarts, n.ends_run) for n in launch.nodes]
    assert policies == [
        ("never", 3, False),
        ("on_failure", 3, False),
        ("always", 7, False),
        ("never", 3, True),
    ]
    assert launch.nodes[2].restart.delay_s == 2.0


NODE = "nodes:\n  - {name: one, node: fitter}\n"
ERRORS = [
    ("nodes:\n  - name: one\n   node: a\n", 3, "not YAML"),
    ("description: a: b\n", 1, "not YAML"),
    ("- a\n- b\n", 1, "must be a mapping"),
    ("description: nothing\n", 1, "neither 'nodes' nor 'include'"),
    ("description: x\nnods: []\n", 2, "unknown key 'nods' in launch file; did you mean 'nodes'?"),
    ("nodes:\n  - name: one\n    nde: fitter\n", 3, "unknown key 'nde' in node; did you mean"),
    ("nodes:\n  - name: one\n", 2, "lacks key 'node'"),
    ("nodes:\n  - node: fitter\n", 2, "lacks key 'name'"),
    ("nodes:\n  - fitter\n", 2, "node must be a mapping"),
    ("nodes: fitter\n", 1, "'nodes' of launch file is 'fitter', expected a list"),
    (NODE + "nodes: []\n", 3, "key 'nodes' a second time; first in line 1"),
    (NODE + "  - {name: one, node: world}\n", 3, "node 'one' a second time"),
    ("nodes:\n  - {name: One, node: fitter}\n", 2, "node name 'One'"),
    ("nodes:\n  - {name: ../x, node: fitter}\n", 2, "node name '../x'"),
    ("nodes:\n  - {name: one, node: 3}\n", 2, "'node' of node is 3, expected a text"),
    ("nodes:\n  - name: one\n    node: a\n    restart: sometimes\n", 4, "policy 'sometimes'"),
    ("nodes:\n  - name: one\n    node: a\n    on_exit: restart\n", 4, "expected 'shutdown'"),
    (
        "nodes:\n  - name: one\n    node: a\n    restart: {max_restarts: 3}\n",
        4,
        "lacks key 'policy'",
    ),
    (
        "nodes:\n  - name: one\n    node: a\n    restart: {policy: always, max_restarts: 0.5}\n",
        4,
        "'max_restarts' of restart of node 'one' is 0.5, expected a whole number",
    ),
    (
        "nodes:\n  - name: one\n    node: a\n    restart: {policy: always, delay_s: -1}\n",
        4,
        "'delay_s' is negative",
    ),
    (
        "nodes:\n  - {name: one, node: a}\n  - name: two\n    node: a\n    when: 3\n",
        5,
        "'when' of node",
    ),
    ("nodes:\n  - {name: one, node: a, parameters: [1]}\n", 2, "expected a mapping"),
    (
        "arguments:\n  scans: {default: 3}\nnodes:\n  - name: one\n    node: a\n"
        "    parameters:\n      scans: $(var scan)\n",
        7,
        "no argument 'scan'; did you mean 'scans'?",
    ),
    ("nodes:\n  - name: one\n    node: $(env HOME)\n", 3, "unknown substitution $(env HOME)"),
    ("nodes:\n  - name: one\n    node: $(var\n", 3, "$( without its )"),
    ("arguments:\n  scans: 3\n" + NODE, 2, "argument 'scans' must be a mapping"),
    (
        "arguments:\n  scans: {type: integer}\n" + NODE,
        2,
        "unknown type 'integer'; did you mean 'int'",
    ),
    ("arguments:\n  scans: {defalt: 3}\n" + NODE, 2, "did you mean 'default'?"),
    ("arguments:\n  sc-ans: {default: 3}\n" + NODE, 2, "argument name 'sc-ans'"),
    (
        "arguments:\n  scans: {description: how many}\n" + NODE,
        2,
        "'scans' (how many) must be given",
    ),
    ("arguments:\n  scans: {default: x, type: int}\n" + NODE, 2, "'scans' is 'x', expected int"),
    (
        "arguments:\n  mode: {default: c, choices: [a, b]}\n" + NODE,
        2,
        "argument 'mode' is 'c', expected a, b",
    ),
    ("include:\n  - {file: missing.yaml}\n", 2, "no file"),
    ("include:\n  - {arguments: {}}\n", 2, "lacks key 'file'"),
    ("include:\n  - {file: rig.yaml}\n", 2, "in a loop: rig.yaml -> rig.yaml"),
    ("nodes:\n  - !!python/object:os.system {name: one}\n", 2, "tag"),
    ("nodes: &a\n  - *a\n", 1, "contains itself"),
    ("1: 2\n", 1, "a key that is no text"),
]


@pytest.mark.parametrize(("text", "line", "what"), ERRORS, ids=[e[2][:40] for e in ERRORS])
def test_every_error_has_its_file_and_line(tmp_path: Path, text: str, line: int, what: str) -> None:
    with pytest.raises(LaunchError) as caught:
        load(tmp_path, text)
    message = str(caught.value)
    assert message.startswith(f"{tmp_path}/rig.yaml:{line}: ")
    assert what in message
    assert "\n" not in message


def test_loops_of_several_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "b.yaml").write_text("include:\n  - {file: c.yaml}\n")
    (tmp_path / "c.yaml").write_text("description: c\ninclude:\n  - {file: rig.yaml}\n")
    with pytest.raises(LaunchError, match=r"c\.yaml:3: .*rig\.yaml -> b\.yaml -> c\.yaml -> rig"):
        load(tmp_path, "include:\n  - {file: b.yaml}\n")


def test_errors_in_includes_name_the_included_file(tmp_path: Path) -> None:
    (tmp_path / "b.yaml").write_text("arguments: {model: {default: 1}}\nnodes:\n  - {nme: x}\n")
    with pytest.raises(LaunchError, match=r"b\.yaml:3: unknown key 'nme'"):
        load(tmp_path, "include:\n  - {file: b.yaml}\n")
    with pytest.raises(
        LaunchError, match=r"rig\.yaml:2: unknown argument 'modl'; did you mean 'model'"
    ):
        load(tmp_path, "include:\n  - {file: b.yaml, arguments: {modl: 2}}\n")
    with pytest.raises(LaunchError, match=r"rig\.yaml:2: argument 'model' is \[2\], expected int"):
        load(tmp_path, "include:\n  - {file: b.yaml, arguments: {model: [2]}}\n")


@pytest.mark.parametrize(
    ("given", "what"),
    [
        ({"scan": "3"}, "unknown argument 'scan'; did you mean 'scans'?"),
        ({"scans": "many"}, "argument 'scans' is 'many', expected int"),
        ({"scans": "[1"}, "not YAML"),
        ({"speedup": "10"}, "speedup is for rigs that are simulated altogether"),
    ],
)
def test_wrong_arguments_are_of_the_command_line(
    tmp_path: Path, given: dict[str, str], what: str
) -> None:
    with pytest.raises(LaunchError) as caught:
        load(tmp_path, "arguments: {scans: {default: 3}}\n" + NODE, **given)
    assert str(caught.value).startswith("command line")
    assert what in str(caught.value)


@pytest.mark.parametrize("words", [["scans=3"], ["3"], [":=3"], ["a:=1", "a:=2"], ["a-b:=1"]])
def test_words_that_assign_nothing_are_refused(words: list[str]) -> None:
    with pytest.raises(LaunchError, match="command line"):
        parse_assignments(words)


def test_values_may_hold_anything() -> None:
    assert parse_assignments(["a:=x:=y", "b:="]) == {"a": "x:=y", "b": ""}


@pytest.mark.parametrize(
    ("raw", "what"), [(b"a: \xff\n", ":1: not UTF-8"), (b"\n\na: \x00", "not YAML")]
)
def test_files_that_are_no_text(tmp_path: Path, raw: bytes, what: str) -> None:
    path = tmp_path / "x.yaml"
    path.write_bytes(raw)
    with pytest.raises(LaunchError, match=what):
        load_declaration(path)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(LaunchError, match="can't read it: No such file"):
        load_declaration(tmp_path / "x.yaml")
