"""Bags: what a run said, in MCAP files that other tools open too."""

from .about import CALIBRATION, LAUNCH, NOTES, SCENE, SOURCE, About, attachment_kind
from .check import CheckReport, Problem, check_bag
from .clock_jumps import ClockJump
from .edit import EditReport, filter_bag, merge_bags
from .errors import (
    BagDamagedError,
    BagEmptyError,
    BagError,
    BagFloorError,
    BagForeignError,
    BagIncompleteError,
    BagTopicError,
    BagVersionError,
    BagWriteError,
)
from .reader import BagReader
from .recovery import Lost, RecoverReport, recover
from .stored import RawMessage, Recorded
from .streams import Stream
from .summary import AttachmentSummary, BagSummary, FileSummary, TopicSummary
from .topic_filter import TopicFilter
from .writer import BagWriter

__all__ = [
    "CALIBRATION",
    "LAUNCH",
    "NOTES",
    "SCENE",
    "SOURCE",
    "About",
    "AttachmentSummary",
    "BagDamagedError",
    "BagEmptyError",
    "BagError",
    "BagFloorError",
    "BagForeignError",
    "BagIncompleteError",
    "BagReader",
    "BagSummary",
    "BagTopicError",
    "BagVersionError",
    "BagWriteError",
    "BagWriter",
    "CheckReport",
    "ClockJump",
    "EditReport",
    "FileSummary",
    "Lost",
    "Problem",
    "RawMessage",
    "Recorded",
    "RecoverReport",
    "Stream",
    "TopicFilter",
    "TopicSummary",
    "attachment_kind",
    "check_bag",
    "filter_bag",
    "merge_bags",
    "recover",
]
