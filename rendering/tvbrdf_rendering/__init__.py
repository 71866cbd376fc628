"""Pictures of what was measured."""

from .report import make_report

__all__ = ["make_report"]
