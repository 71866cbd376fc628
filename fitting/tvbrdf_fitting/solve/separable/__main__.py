"""``python -m tvbrdf_fitting.solve.separable``: compile all there is, so that nothing later waits.

The compiled code is kept beside the sources, or where NUMBA_CACHE_DIR says.
"""

from __future__ import annotations

import sys

from ...published import compiled as _reader  # noqa: F401 # compiles when it is imported
from . import compile_all

if __name__ == "__main__":
    sys.stderr.write(f"compiled the separable solver in {compile_all():.1f} s\n")
