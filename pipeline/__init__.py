"""The library. `import pipeline` is instant: the names below are imported when they are used (PEP 562)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipeline.api import EvaluationConfig, Model, Outcome, Result, RunConfig, evaluate, load_model, train

__all__ = ["EvaluationConfig", "Model", "Outcome", "Result", "RunConfig", "evaluate", "load_model", "train"]
WHERE = {"EvaluationConfig": "config", "RunConfig": "config", "Outcome": "training.trainer"}  # all others: api


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'pipeline' has no attribute '{name}'; it has {', '.join(__all__)}")
    from importlib import import_module

    return getattr(import_module(f"pipeline.{WHERE.get(name, 'api')}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
