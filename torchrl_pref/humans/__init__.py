"""Who answers: simulated humans."""

from torchrl_pref.humans.base import HumanBase
from torchrl_pref.humans.drifting import Drifting
from torchrl_pref.humans.imperfect import Myopic, Skipping, Undecided
from torchrl_pref.humans.simulated import SimulatedHuman

HUMANS: dict[str, type[HumanBase]] = {
    "simulated": SimulatedHuman,
    "drifting": Drifting,
    "myopic": Myopic,
    "skipping": Skipping,
    "undecided": Undecided,
}
"""The kinds of human by name; each is made with a response model and its own settings."""
