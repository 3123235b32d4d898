"""Driver and LDS beside the code that their authors released: the same controls, the same features.

``python benchmarks/authors.py`` needs https://github.com/Stanford-ILIAD/easy-active-learning (Bıyık
and others, *Asking easy questions*, CoRL 2019) on ``PYTHONPATH``, and PyTensor, which goes on where
Theano ended and is handed to that code under its name. What only its other tasks need (MuJoCo,
Gym, a window) is left out. Theirs runs one trajectory after the other, ours all at once.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # this folder's select.py hides Python's

import importlib
import time
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks import common
from torchrl_pref.tasks.controlled import ControlledTask
from torchrl_pref.tasks.driver import DriverTask
from torchrl_pref.tasks.lds import LDSTask

LEFT_OUT = ("mujoco_py", "gym", "visualize", "fetch_gym")


def main() -> None:
    """Print the table."""
    parser = common.arguments(__doc__)
    parser.add_argument("--count", type=int, default=2000, help="trajectories (default 2000)")
    typed = common.start(parser)
    try:
        models = import_released()
    except ImportError as error:
        parser.error(
            f"{error}; pip install pytensor, and put a clone of "
            "https://github.com/Stanford-ILIAD/easy-active-learning on PYTHONPATH"
        )
    motions = models.LDS()
    motions.initial_state = motions.initial_state.astype(float)  # or it computes in float32
    cases: dict[str, tuple[ControlledTask, Any, Callable[[Tensor], Tensor]]] = {
        "driver": (DriverTask(), models.Driver(), lambda controls: controls),
        "lds, task.released_inputs=true": (LDSTask(True), motions, lambda controls: controls),
        # A row of three for each segment is what its bug is about: then each goes to its own point.
        "lds": (LDSTask(), motions, lambda controls: controls.view(-1, 5, 3)),
    }
    rows = [row(name, *case, typed.count) for name, case in cases.items()]
    title = f"Features of {typed.count:,} trajectories, beside the authors' code"
    common.report(title, rows, typed.json)


def import_released() -> Any:
    """Their module of tasks.

    Raises:
        ImportError: it, or PyTensor, is not there.
    """
    pytensor = importlib.import_module("pytensor")
    theano = ModuleType("theano")
    parts = {"function": pytensor.function, "shared": pytensor.shared, "config": SimpleNamespace()}
    tensor = importlib.import_module("pytensor.tensor")
    vars(theano).update(parts, tensor=tensor)
    sys.modules.update({"theano": theano, "theano.tensor": tensor})
    for name in LEFT_OUT:
        sys.modules[name] = Nothing(name)
    return importlib.import_module("models")


class Nothing(ModuleType):
    """A module all of whose names there are, and mean nothing."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {})


def row(
    name: str,
    task: ControlledTask,
    simulator: Any,
    as_they_take: Callable[[Tensor], Tensor],
    count: int,
) -> common.Row:
    """How far both are apart on controls that are drawn at random, and how long both take."""
    controls, features = task.draw(count, seed=0).double(), []
    start = time.process_time()
    for control in tqdm(as_they_take(controls).tolist(), desc=name, unit="trajectory"):
        simulator.feed(control)
        features.append(simulator.get_features())
    their_seconds = time.process_time() - start
    found = torch.tensor(features, dtype=torch.float64)
    ours, seconds = timed(task, controls)
    rough, _ = timed(task, controls.float())
    return {
        "task": name,
        "largest feature": float(found.abs().max()),
        "largest difference": f"{float((ours - found).abs().max()):.1e}",
        "in float32": f"{float((rough - found).abs().max()):.1e}",
        "their ms a trajectory": 1e3 * their_seconds / count,
        "our ms": 1e3 * seconds / count,
    }


def timed(task: ControlledTask, controls: Tensor) -> tuple[Tensor, float]:
    """Features (count D), in float64, and the CPU seconds that they took."""
    start = time.process_time()
    found = task.features(task.roll_out(controls))
    return found.double(), time.process_time() - start


if __name__ == "__main__":
    main()
