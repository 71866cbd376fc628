"""``tvbrdf topic echo``."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from .._common import Subparsers, add_verb, count, print_json
from ._watch import add_watch_options, watch

if TYPE_CHECKING:
    from tvbrdf_messages.envelope import Envelope

SHOWN_ELEMENTS = 128


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(subparsers, "echo", run, "print the messages of a topic")
    add_watch_options(parser)
    parser.add_argument("-n", type=count, metavar="COUNT", help="end after that many messages")
    parser.add_argument("--once", action="store_true", help="end after the first message")
    parser.add_argument(
        "--field", metavar="NAME", help="print one field only, e.g. angle_deg or header.stamp_ns"
    )
    parser.add_argument("--no-arr", action="store_true", help="print type and shape of arrays only")
    parser.add_argument(
        "-f", "--full-length", action="store_true", help="print all elements of arrays"
    )
    parser.add_argument(
        "-l",
        "--truncate-length",
        type=count,
        default=SHOWN_ELEMENTS,
        metavar="COUNT",
        help=f"elements of an array to print (default {SHOWN_ELEMENTS})",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    from ...errors import RunError

    wanted = 1 if arguments.once else arguments.n
    shown = 0
    for arrival in watch(arguments):
        if arrival is None:
            continue
        _print(_plain(arrival.envelope, arguments), arguments)
        shown += 1
        if shown == wanted:
            return 0
    if wanted is not None:
        raise RunError(f"{shown} of {wanted} messages came on {arguments.topic} before the end")
    return 0


def _print(value: Any, arguments: argparse.Namespace) -> None:
    if arguments.json:
        print_json(value)
        return
    import yaml

    text = yaml.safe_dump(value, sort_keys=False, allow_unicode=True, default_flow_style=None)
    print(text.removesuffix("...\n"), end="")
    print("---", flush=True)


def _plain(envelope: Envelope, arguments: argparse.Namespace) -> Any:
    """Return a message, or the one field asked for, in plain values."""
    fields = {f.name: f.name for f in envelope.message.schema()}
    value: Any = {
        "header": envelope.header._asdict(),
        **{name: getattr(envelope.message, name) for name in fields},
    }
    if arguments.field:
        value = _pick(value, arguments.field)
    return _simplify(value, arguments)


def _pick(value: Any, path: str) -> Any:
    from ...errors import RunError, did_you_mean

    for part in path.split("."):
        if not isinstance(value, dict) or part not in value:
            known = value if isinstance(value, dict) else ()
            raise RunError(f"no field {part!r} (of {path}); {did_you_mean(part, known)}")
        value = value[part]
    return value


def _simplify(value: Any, arguments: argparse.Namespace) -> Any:
    if isinstance(value, dict):
        return {key: _simplify(part, arguments) for key, part in value.items()}
    if hasattr(value, "dtype"):
        return _simplify_array(value, arguments)
    if isinstance(value, (list, tuple)):
        if arguments.no_arr:
            return f"<sequence, length: {len(value)}>"
        whole = arguments.full_length or len(value) <= arguments.truncate_length
        parts = value if whole else value[: arguments.truncate_length]
        return [_simplify(part, arguments) for part in parts] + ([] if whole else ["..."])
    return value


def _simplify_array(value: Any, arguments: argparse.Namespace) -> Any:
    if arguments.no_arr:
        return f"<array type: {value.dtype}[{', '.join(map(str, value.shape))}]>"
    if arguments.full_length or value.size <= arguments.truncate_length:
        return value.tolist()
    return [*value.ravel()[: arguments.truncate_length].tolist(), "..."]
