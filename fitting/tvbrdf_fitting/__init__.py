"""Reflectance models, fits and all other pure numerics of tvbrdf: numpy in, numpy out.

Names are loaded when first used: a node that needs the geometry alone does not wait for scipy.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .batch import ParameterBatch, fit_parameters
    from .choice.choose import ModelChoice, choose_for_series, choose_model
    from .design.search import find_designs
    from .error_measures import ErrorMeasures, measure_errors, pool
    from .fit import fit_scan
    from .inference.nuisances import CommonErrors
    from .many_scans import fit_scans
    from .models import get_model
    from .observations import Observations
    from .prediction import predict, predict_over_models
    from .problem import FitError
    from .published import read_sample, read_scan
    from .result import FitResult

_MODULES = {
    "CommonErrors": "inference.nuisances",
    "ErrorMeasures": "error_measures",
    "FitError": "problem",
    "FitResult": "result",
    "ModelChoice": "choice.choose",
    "Observations": "observations",
    "ParameterBatch": "batch",
    "choose_for_series": "choice.choose",
    "choose_model": "choice.choose",
    "find_designs": "design.search",
    "fit_parameters": "batch",
    "fit_scan": "fit",
    "fit_scans": "many_scans",
    "get_model": "models",
    "measure_errors": "error_measures",
    "pool": "error_measures",
    "predict": "prediction",
    "predict_over_models": "prediction",
    "read_sample": "published",
    "read_scan": "published",
}

__all__ = [
    "CommonErrors",
    "ErrorMeasures",
    "FitError",
    "FitResult",
    "ModelChoice",
    "Observations",
    "ParameterBatch",
    "choose_for_series",
    "choose_model",
    "find_designs",
    "fit_parameters",
    "fit_scan",
    "fit_scans",
    "get_model",
    "measure_errors",
    "pool",
    "predict",
    "predict_over_models",
    "read_sample",
    "read_scan",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_MODULES[name]}", __name__), name)
