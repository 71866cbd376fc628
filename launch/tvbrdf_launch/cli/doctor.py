"""``tvbrdf doctor``: is this machine ready to measure?"""

from __future__ import annotations

import argparse

from ._common import Subparsers, add_json_option, add_verb, print_json

SYMBOLS = {"ok": "ok  ", "warn": "WARN", "fail": "FAIL"}


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(subparsers, "doctor", run, "check whether this machine is ready to measure")
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    from ..checks import run_checks

    findings = run_checks()
    if arguments.json:
        print_json([finding._asdict() for finding in findings])
    else:
        for finding in findings:
            print(f"{SYMBOLS[finding.state]}  {finding.name}: {finding.text}")
            if finding.advice:
                print(f"      {finding.advice}")
    return 1 if any(finding.state == "fail" for finding in findings) else 0
