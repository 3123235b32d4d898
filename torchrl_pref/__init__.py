"""Preference-based reward learning on TorchRL: choose which question to ask a person next."""

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
