"""The published database's text layout, read and written.

One public face of :mod:`.scan` and :mod:`.scan_file` (``tvBrdf-data/``), :mod:`.info`
(``tvBrdf-info.txt``) and :mod:`.sample` (fits, calibration), which state the layout.
Colours are in B, G, R order everywhere. Readers are strict: an error names file, line and what was
wrong. Writers are their exact inverses to the 6 decimals of the layout, and write a whole file or
none.
"""

from __future__ import annotations

from .info import (
    SampleInfo,
    ScanInfo,
    format_info,
    format_stamp,
    read_info,
    write_info,
)
from .sample import (
    DUST_PARAMETERS,
    SURFACE_PARAMETERS,
    PublishedRow,
    PublishedSample,
    format_parameters,
    list_samples,
    parameters_row,
    read_calibration,
    read_parameters,
    read_sample,
    write_calibration,
    write_parameters,
)
from .scan import (
    CAMERAS,
    PublishedScan,
    list_scans,
    parse_scan_file_name,
    read_scan,
    scan_file_name,
)
from .scan_file import CameraScan, format_scan_file, read_scan_file, write_scan_file
from .text import PublishedFormatError, write_atomically

__all__ = [
    "CAMERAS",
    "DUST_PARAMETERS",
    "SURFACE_PARAMETERS",
    "CameraScan",
    "PublishedFormatError",
    "PublishedRow",
    "PublishedSample",
    "PublishedScan",
    "SampleInfo",
    "ScanInfo",
    "format_info",
    "format_parameters",
    "format_scan_file",
    "format_stamp",
    "list_samples",
    "list_scans",
    "parameters_row",
    "parse_scan_file_name",
    "read_calibration",
    "read_info",
    "read_parameters",
    "read_sample",
    "read_scan",
    "read_scan_file",
    "scan_file_name",
    "write_atomically",
    "write_calibration",
    "write_info",
    "write_parameters",
    "write_scan_file",
]
