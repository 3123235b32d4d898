"""Where trajectories come from, and their features."""

from torchrl_pref.tasks.base import Task
from torchrl_pref.tasks.driver import DriverTask
from torchrl_pref.tasks.gridworld import GridworldTask
from torchrl_pref.tasks.lds import LDSTask

TASKS: dict[str, type[Task]] = {
    "gridworld": GridworldTask,
    "driver": DriverTask,
    "lds": LDSTask,
}
"""The tasks by name."""
