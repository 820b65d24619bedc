"""Evaluation: baselines, roll-outs, scenarios, figures of merit; `evaluate` a policy, or `compare` many."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxouter.evaluation.comparison import compare
    from jaxouter.evaluation.policies import evaluate

__all__ = ["compare", "evaluate"]


def __getattr__(name: str) -> Any:
    """Import the functions on first use, as the modules of this package import each other."""
    if name == "compare":
        from jaxouter.evaluation.comparison import compare

        return compare
    if name == "evaluate":
        from jaxouter.evaluation.policies import evaluate

        return evaluate
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
