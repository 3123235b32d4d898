"""Who answers: simulated humans."""

from torchrl_pref.humans.base import HumanBase
from torchrl_pref.humans.simulated import SimulatedHuman

HUMANS: dict[str, type[HumanBase]] = {"simulated": SimulatedHuman}
"""The kinds of human by name; each is made with a response model and its own settings."""
