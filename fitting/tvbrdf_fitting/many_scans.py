"""Fit many scans, each with all that `fit_scan` gives, on several cores."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from typing import Any

from .fit import fit_scan
from .models import SURFACE, get_model
from .observations import Observations
from .result import FitResult

_CHUNK = 8
"""Scans handed to a process at a time."""


def fit_scans(
    scans: Iterable[Observations], model: str = SURFACE, *, jobs: int = 1, **options: Any
) -> list[FitResult]:
    """Fit a model to each of several scans; results are in their order and as those of `fit_scan`.

    For many scans with the same directions of which only parameters are wanted, `fit_parameters`
    is faster by an order of magnitude.

    Parameters
    ----------
    scans
        Observations of each.
    model
        Name for `get_model`.
    jobs
        Processes. They start by importing the main module again, so a script that asks for more
        than one must do its work below ``if __name__ == "__main__":``. With one, nothing is
        started.
    options
        Of `fit_scan`.

    Raises
    ------
    FitError, ValueError
        As `fit_scan`, for the first scan that cannot be fitted; its place is in the notes.
    """
    get_model(model)  # an unknown name is refused before anything starts
    work = partial(_fit, model=model, options=options)
    numbered = list(enumerate(scans))
    if jobs <= 1 or len(numbered) < 2:
        return [work(pair) for pair in numbered]
    count = min(jobs, len(numbered))
    chunk = max(1, min(_CHUNK, len(numbered) // count))
    with ProcessPoolExecutor(count, mp_context=get_context("spawn")) as pool:
        return list(pool.map(work, numbered, chunksize=chunk))


def _fit(pair: tuple[int, Observations], model: str, options: dict[str, Any]) -> FitResult:
    number, observations = pair
    try:
        return fit_scan(observations, model, **options)
    except ValueError as error:
        error.add_note(f"while fitting scan {number} of the given ones, counted from 0")
        raise
