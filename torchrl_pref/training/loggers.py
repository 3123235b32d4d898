"""Where the numbers of a training go while it runs: its table, and TorchRL's loggers.

``csv`` is ``training.csv``, a row for each update (:mod:`torchrl_pref.training.progress`).
TorchRL's logger of that name writes a file for each metric, and is not used. The others are
TorchRL's.
Each process that trains is a run of its own for ``wandb`` and ``mlflow``: a resumed training is a
second one, of the same name, that goes on at the update where it was resumed.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from torchrl.record.loggers import Logger
from torchrl.record.loggers.mlflow import MLFlowLogger
from torchrl.record.loggers.tensorboard import TensorboardLogger
from torchrl.record.loggers.wandb import WandbLogger

from torchrl_pref.errors import InputError
from torchrl_pref.training.progress import Progress, add_row, start_table

PROJECT = "torchrl_pref"
"""What groups the runs of this package, in wandb and in mlflow."""


def _tensorboard(folder: Path, stack: ExitStack) -> Logger:
    logger = TensorboardLogger("tensorboard", str(folder))
    stack.callback(logger.close)
    return logger


def _wandb(folder: Path, stack: ExitStack) -> Logger:
    """Online, or as the environment variable ``WANDB_MODE`` says."""
    # Which packages are installed, and where, is nobody's business.
    logger = WandbLogger(folder.name, log_dir=str(folder), project=PROJECT, log_env_packages=False)
    stack.callback(logger.close)
    return logger


def _mlflow(folder: Path, stack: ExitStack) -> Logger:
    """To the server of ``MLFLOW_TRACKING_URI``, or to a database in the folder."""
    import mlflow

    server = os.environ.get("MLFLOW_TRACKING_URI")
    database = f"sqlite:///{folder / 'mlflow.db'}"
    artifacts = None if server else (folder / "mlflow").as_uri()
    logger = MLFlowLogger(PROJECT, server or database, artifact_location=artifacts)
    stack.callback(mlflow.end_run)  # TorchRL's close does not
    mlflow.set_tag("mlflow.runName", folder.name)
    return logger


LOGGERS: dict[str, Callable[[Path, ExitStack], Logger]] = {
    "tensorboard": _tensorboard,
    "wandb": _wandb,
    "mlflow": _mlflow,
}
"""Each starts a logger for the run of a folder, and leaves with the stack what ends it."""


class Logs:
    """What a training tells to the loggers that were chosen.

    Args:
        loggers: TorchRL's.
        table: ``training.csv``; None where none is wanted.
        frames: steps of all sessions in one update.
    """

    def __init__(self, loggers: Sequence[Logger], table: Path | None, frames: int) -> None:
        self.loggers, self.table, self.frames = loggers, table, frames

    def start(self, progress: Progress) -> None:
        """Tell what is known before the first update of this process.

        Raises:
            InputError: the table cannot be written.
        """
        if self.table is not None:
            start_table(self.table, progress, self.frames)
        if progress.update == 0:
            self._log(progress)

    def add(self, progress: Progress) -> None:
        """Tell of the last update."""
        if self.table is not None:
            add_row(self.table, progress, self.frames)
        self._log(progress)

    def _log(self, progress: Progress) -> None:
        known = {name: values[-1] for name, values in progress.history.items() if values}
        known = {name: value for name, value in known.items() if not math.isnan(value)}
        if progress.update in progress.held_out:
            known["held_out/alignment"] = float(progress.held_out[progress.update].mean())
        for logger in self.loggers if known else ():
            logger.log_metrics(known, step=progress.update)


@contextmanager
def opened(names: Sequence[str], folder: Path, frames: int) -> Iterator[Logs]:
    """The logs of a training, ended with the block.

    Args:
        names: ``csv`` and keys of ``LOGGERS``; none is as good as any.
        folder: of the run.
        frames: steps of all sessions in one update.

    Raises:
        InputError: a logger does not start.
    """
    with ExitStack() as stack:
        loggers = []
        for name in names:
            if name != "csv":
                try:
                    loggers.append(LOGGERS[name](folder.absolute(), stack))
                except Exception as error:  # a disk, a server or an account: none is a defect here
                    mend = "log in or set WANDB_MODE=offline" if name == "wandb" else "mend that"
                    raise InputError(
                        f"logger={name} does not start ({type(error).__name__}: {error}); {mend}, "
                        f"or leave {name} out of logger="
                    ) from error
        yield Logs(loggers, folder / "training.csv" if "csv" in names else None, frames)
