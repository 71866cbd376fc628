"""What a bag holds, in forms that other tools read: published text, OpenEXR, protobuf."""

from __future__ import annotations

from .exporter import FORMATS, Report, export_bag

__all__ = ["FORMATS", "Report", "export_bag"]
