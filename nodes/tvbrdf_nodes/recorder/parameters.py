"""Parameters of the recorder's node."""

from __future__ import annotations

import re
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class RecorderParameters:
    """What is recorded, where to, and what happens when it can't be."""

    path: str
    """A new folder, or a new file ``NAME.mcap``."""
    topics: tuple[str, ...] = ()
    """Full names; none and no ``regex``: all that the table of topics marks as recorded."""
    regex: str = ""
    """Topics that contain it are recorded too."""
    exclude: str = ""
    """Topics that contain it are not."""
    full_frames: bool = False
    """Whether pixels are kept too that the calibration uses for nothing."""
    calibration: str = ""
    """Says which pixels are used; empty: all are kept."""
    cameras: tuple[str, ...] = ("camera_1", "camera_2", "camera_3", "camera_4")
    """In the calibration's order."""
    margin: float = 0.05
    """Kept around what the calibration uses, as a part of the image's width and height."""
    split_s: float = 0.0
    """A new file begins after this time on the run's clock; 0: never."""
    split_mb: float = 0.0
    """A new file begins after this size; 0: never."""
    floor_free_mb: float = 256.0
    """Recording ends when less of the disk is free."""
    compression: str = "lz4"
    """``lz4`` where it shrinks, or ``none``."""
    required: bool = False
    """Whether the run waits for the recorder, and ends when it fails. Else what the recorder has
    no room for is left out, and the gap recorded."""
    queue_mb: float = 128.0
    """Of each publisher, how much may wait for the recorder unless it is required."""

    def __post_init__(self) -> None:
        """Refuse values that make no sense."""
        if not self.path:
            raise ValueError("path is empty: name a new folder or a new .mcap file")
        if min(self.split_s, self.split_mb, self.floor_free_mb) < 0 or self.queue_mb <= 0:
            raise ValueError(
                "split_s, split_mb and floor_free_mb must be 0 or more, queue_mb above 0"
            )
        if not 0 <= self.margin <= 1:
            raise ValueError(f"margin is {self.margin:g}, expected 0 to 1")
        if self.compression not in ("lz4", "none"):
            raise ValueError(f"compression is {self.compression!r}, expected lz4 or none")
        if (self.split_s or self.split_mb) and self.path.endswith(".mcap"):
            raise ValueError(f"path {self.path} is one file; a bag in parts is a folder")
        for name in ("regex", "exclude"):
            try:
                re.compile(getattr(self, name))
            except re.error as error:
                raise ValueError(f"{name} is no regular expression: {error}") from error
