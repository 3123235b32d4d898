"""What a query is worth: acquisition functions, and their scores of many candidates at once."""

from torchrl_pref.acquisition.functions import (
    Acquisition,
    alignment_gain,
    information_gain,
    volume_removal,
)

ACQUISITIONS: dict[str, Acquisition] = {
    "information_gain": information_gain,
    "alignment_gain": alignment_gain,
    "volume_removal": volume_removal,
}
"""The acquisition functions by name."""
