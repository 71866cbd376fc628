"""The command ``tvbrdf``: one file a verb, each with ``add_parser`` and ``run``."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from . import (
    arm,
    bag,
    bench,
    demo,
    design,
    doctor,
    fit,
    launch,
    mark,
    model,
    node,
    preview,
    refit,
    report,
    samples,
    scan,
    stop,
    topic,
)

VERBS = (
    demo,
    launch,
    stop,
    topic,
    node,
    arm,
    scan,
    preview,
    mark,
    report,
    bag,
    fit,
    refit,
    samples,
    model,
    design,
    bench,
    doctor,
)
EXIT_ERROR, EXIT_INTERRUPTED = 1, 130
OUR_PACKAGES = (
    "tvbrdf_fitting",
    "tvbrdf_messages",
    "tvbrdf_nodes",
    "tvbrdf_launch",
    "tvbrdf_rendering",
)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command line."""
    root = argparse.ArgumentParser(
        prog="tvbrdf",
        description="Measures how a material's reflectance changes with time.",
        epilog="tvbrdf VERB --help tells more of each.",
    )
    root.add_argument("--version", action="store_true", help="print the version and end")
    verbs = root.add_subparsers(title="verbs", metavar="VERB", dest="verb")
    for verb in VERBS:
        verb.add_parser(verbs)
    return root


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb; return the exit status: 0, 1 (an error, told in one line), 2 (usage)."""
    root = parser()
    arguments, rest = root.parse_known_args(argv)
    if rest and hasattr(arguments, "arguments") and all(":=" in word for word in rest):
        arguments.arguments += rest  # key:=value words may stand after options
    elif rest:
        root.error(f"unrecognized arguments: {' '.join(rest)}")
    if arguments.version:
        from ..run_folder import installed_version

        print(installed_version())
        return 0
    if arguments.verb is None:
        root.print_help()
        return 0
    try:
        status = int(arguments.run(arguments))
        sys.stdout.flush()
        return status
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        # the reader has gone; nothing may be written at exit either
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_ERROR
    except Exception as error:
        text = _explain(error)
        if text is None:
            error.add_note("tvbrdf: this was not foreseen; please report it with the lines above")
            raise
        sys.stderr.write(f"tvbrdf: error: {text}\n")
        return EXIT_ERROR


def _explain(error: Exception) -> str | None:
    """Return an expected error in one line; None for one that is a fault of this program.

    Errors of our own classes say what was wrong with what was given, and what to do. A plain
    ``ValueError`` or ``KeyError`` may be anything: whoever calls what raises it for bad input makes
    it one of ours.
    """
    kind = type(error)
    if kind.__module__.partition(".")[0] in OUR_PACKAGES:
        return "; ".join(" ".join(text.split()) for text in (str(error), *_notes(error)))
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror or error}"
    return None


def _notes(error: Exception) -> list[str]:
    return getattr(error, "__notes__", [])
