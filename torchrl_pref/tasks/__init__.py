"""Where trajectories come from, and their features."""

from torchrl_pref.tasks.base import Task
from torchrl_pref.tasks.driver import DriverTask
from torchrl_pref.tasks.files import FilesTask
from torchrl_pref.tasks.gaussian import GaussianTask
from torchrl_pref.tasks.gridworld import GridworldTask
from torchrl_pref.tasks.gymnasium import GymnasiumTask
from torchrl_pref.tasks.lds import LDSTask
from torchrl_pref.tasks.minari import MinariTask
from torchrl_pref.tasks.torchrl import TorchRLTask

TASKS: dict[str, type[Task]] = {
    "gridworld": GridworldTask,
    "driver": DriverTask,
    "lds": LDSTask,
    "gymnasium": GymnasiumTask,
    "torchrl": TorchRLTask,
    "gaussian": GaussianTask,
    "files": FilesTask,
    "minari": MinariTask,
}
"""The tasks by name."""
