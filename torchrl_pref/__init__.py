"""Preference-based reward learning on TorchRL: choose which question to ask a person next.

The names below are imported when they are first used: TorchRL takes seconds, and what only reads
``torchrl_pref.errors`` or ``torchrl_pref.config`` does not need it.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchrl_pref.beliefs.sampled import Belief
    from torchrl_pref.build import load_policy
    from torchrl_pref.envs.feed import FeedEnv
    from torchrl_pref.envs.objectives import alignment
    from torchrl_pref.envs.query import QueryEnv
    from torchrl_pref.humans.simulated import SimulatedHuman
    from torchrl_pref.pool import Normalizer, QueryPool
    from torchrl_pref.questions.calibrate import calibrate_tau
    from torchrl_pref.questions.choice import Choice
    from torchrl_pref.questions.response_model import ResponseModel
    from torchrl_pref.questions.responses import Boltzmann, Optimal
    from torchrl_pref.questions.weak import Weak
    from torchrl_pref.reward import Reward
    from torchrl_pref.session import Session
    from torchrl_pref.tasks.gridworld import gridworld_pool

__all__ = [
    "Belief",
    "Boltzmann",
    "Choice",
    "FeedEnv",
    "Normalizer",
    "Optimal",
    "QueryEnv",
    "QueryPool",
    "ResponseModel",
    "Reward",
    "Session",
    "SimulatedHuman",
    "Weak",
    "alignment",
    "calibrate_tau",
    "gridworld_pool",
    "load_policy",
]

_MODULES = {
    "beliefs.sampled": ("Belief",),
    "build": ("load_policy",),
    "envs.feed": ("FeedEnv",),
    "envs.objectives": ("alignment",),
    "envs.query": ("QueryEnv",),
    "humans.simulated": ("SimulatedHuman",),
    "pool": ("Normalizer", "QueryPool"),
    "questions.calibrate": ("calibrate_tau",),
    "questions.choice": ("Choice",),
    "questions.response_model": ("ResponseModel",),
    "questions.responses": ("Boltzmann", "Optimal"),
    "questions.weak": ("Weak",),
    "reward": ("Reward",),
    "session": ("Session",),
    "tasks.gridworld": ("gridworld_pool",),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
