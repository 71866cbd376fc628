"""Refits what was recorded or stored: the same nodes as in a run, in one process, no sockets."""

from __future__ import annotations

from .job import Refit, Report, TargetReport
from .settings import Settings
from .sources import find_sources

__all__ = ["Refit", "Report", "Settings", "TargetReport", "find_sources"]
