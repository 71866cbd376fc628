"""Reflectance models, fits and all other pure numerics of tvbrdf: numpy in, numpy out.

Names are loaded when first used: a node that needs the geometry alone does not wait for scipy.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .batch import ParameterBatch, fit_parameters
    from .error_measures import ErrorMeasures, measure_errors, pool
    from .fit import fit_scan
    from .many_scans import fit_scans
    from .models import get_model
    from .nuisances import CommonErrors
    from .observations import Observations
    from .problem import FitError
    from .result import FitResult

_MODULES = {
    "CommonErrors": "nuisances",
    "ErrorMeasures": "error_measures",
    "FitError": "problem",
    "FitResult": "result",
    "Observations": "observations",
    "ParameterBatch": "batch",
    "fit_parameters": "batch",
    "fit_scan": "fit",
    "fit_scans": "many_scans",
    "get_model": "models",
    "measure_errors": "error_measures",
    "pool": "error_measures",
}

__all__ = [
    "CommonErrors",
    "ErrorMeasures",
    "FitError",
    "FitResult",
    "Observations",
    "ParameterBatch",
    "fit_parameters",
    "fit_scan",
    "fit_scans",
    "get_model",
    "measure_errors",
    "pool",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_MODULES[name]}", __name__), name)
