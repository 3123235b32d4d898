"""What a query is worth: acquisition functions, and their scores of many candidates at once."""

from torchrl_pref.acquisition.functions import (
    Acquisition,
    alignment_gain,
    information_gain,
    least_confidence,
    volume_removal,
)
from torchrl_pref.acquisition.pairs import disagreement, max_regret
from torchrl_pref.acquisition.per_second import PerSecond

ACQUISITIONS: dict[str, Acquisition] = {
    "information_gain": information_gain,
    "alignment_gain": alignment_gain,
    "volume_removal": volume_removal,
    "max_regret": max_regret,
    "disagreement": disagreement,
    "least_confidence": least_confidence,
    "information_per_second": PerSecond(information_gain),
    "alignment_per_second": PerSecond(alignment_gain),
}
"""The acquisition functions by name. A :class:`KnowledgeGradient` is made of a pool, and so no line
here."""
