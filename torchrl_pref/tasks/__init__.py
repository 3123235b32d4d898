"""Where trajectories come from, and their features."""

from torchrl_pref.tasks.base import Task
from torchrl_pref.tasks.gridworld import GridworldTask

TASKS: dict[str, type[Task]] = {"gridworld": GridworldTask}
"""The tasks by name."""
