"""Preference-based reward learning on TorchRL: choose which question to ask a person next.

The names below are imported when they are first used: TorchRL takes seconds, and what only reads
``torchrl_pref.errors`` or ``torchrl_pref.settings`` does not need it.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchrl_pref.belief import Belief
    from torchrl_pref.envs import FeedEnv, QueryEnv
    from torchrl_pref.features import Normalizer
    from torchrl_pref.humans import SimulatedHuman
    from torchrl_pref.queries import QueryPool, gridworld_pool
    from torchrl_pref.responses import Boltzmann, Optimal, ResponseModel, calibrate_tau

__all__ = [
    "Belief",
    "Boltzmann",
    "FeedEnv",
    "Normalizer",
    "Optimal",
    "QueryEnv",
    "QueryPool",
    "ResponseModel",
    "SimulatedHuman",
    "calibrate_tau",
    "gridworld_pool",
]

_MODULES = {
    "belief": ("Belief",),
    "envs": ("FeedEnv", "QueryEnv"),
    "features": ("Normalizer",),
    "humans": ("SimulatedHuman",),
    "queries": ("QueryPool", "gridworld_pool"),
    "responses": ("Boltzmann", "Optimal", "ResponseModel", "calibrate_tau"),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
