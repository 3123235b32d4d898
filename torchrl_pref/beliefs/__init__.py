"""What is known of a person: beliefs over the weights ω, and how an answer changes them."""

from torchrl_pref.beliefs.base import BeliefBase
from torchrl_pref.beliefs.laplace import LaplaceBelief
from torchrl_pref.beliefs.rationality import RationalityBelief
from torchrl_pref.beliefs.sampled import Belief

BELIEFS: dict[str, type[BeliefBase]] = {
    "sampled": Belief,
    "rationality": RationalityBelief,
    "laplace": LaplaceBelief,
}
"""The beliefs by name; each is made with a response model and its own settings."""
