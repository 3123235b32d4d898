"""What train.py and evaluate.py share: everything that touches Hydra."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import shutil
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import Any, TextIO, cast

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

import typed
from help_text import help_text
from torchrl_pref import runs, sweeps
from torchrl_pref.config.sections import Plain, Settings
from torchrl_pref.config.settings import open_groups
from torchrl_pref.errors import InputError, one_line_errors


class Terminated(KeyboardInterrupt):
    """SIGTERM, which stops a program as Ctrl-C does."""


def main(job: Callable[[], Any], check: Callable[[Plain], Any]) -> None:
    """Run a Hydra job; input that cannot be used ends it with one line and status 2.

    Args:
        job: as decorated by Hydra.
        check: raises an InputError for settings that the job cannot use; it is called before
            anything is made for them.
    """
    if {"--help", "-h"} & set(sys.argv[1:]):
        print(help_text(Path(sys.argv[0]).stem))
        return
    # Without this Hydra prints its own several lines and exits with status 1.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    # Python puts a script's folder on the path of the script alone; a launcher's workers need it.
    path = [str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    os.environ["PYTHONPATH"] = os.pathsep.join(path)
    signal.signal(signal.SIGTERM, _terminate)
    sys.argv[1:] = typed.told_hydra(sys.argv[1:])
    typed.Gate.check, typed.Gate.passed, typed.Gate.made = check, False, ()
    with unbroken_output(), one_line_errors():
        try:
            with typed.refusals(), typed.checked_flags(), sweep_report():
                job()
        except KeyboardInterrupt as stop:
            print("\nstopped", file=sys.stderr)
            raise SystemExit(exit_status(stop)) from None
        except OSError as error:
            raise InputError(
                f"{error.filename}: the run folder cannot be written ({error.strerror}); "
                "set hydra.run.dir to a folder that can be"
            ) from None
        finally:
            typed.discard_folders()


def _terminate(number: int, frame: FrameType | None) -> None:
    raise Terminated


def exit_status(stop: KeyboardInterrupt) -> int:
    """The status with which a shell tells of the signal."""
    return 128 + (signal.SIGTERM if isinstance(stop, Terminated) else signal.SIGINT)


@contextlib.contextmanager
def unbroken_output() -> Iterator[None]:
    """Go on where nobody reads what is printed any more, as after ``| head``."""
    with (
        contextlib.redirect_stdout(_Unbroken(sys.stdout)),
        contextlib.redirect_stderr(_Unbroken(sys.stderr)),
    ):
        yield


class _Unbroken:
    """A stream that turns into the null device when its reader goes."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text, flushed, so that a reader that has gone is noticed here."""
        try:
            written = self._stream.write(text)
            self._stream.flush()
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())
            written = len(text)
        return written


def allow_typed(settings: Plain) -> None:
    """Let the code be imported that the user typed, as in ``policy=mine:make``."""
    typed_by_user = typed.typed_code()
    if typed_by_user:
        from torchrl_pref.typed_code import allow

        for key in typed_by_user:
            group, _, name = key.partition(".")
            allow(str(settings[group][name]))


def refuse_other_code(settings: Mapping[str, Any], new: Mapping[str, Any]) -> None:
    """Refuse code of the user's own, or settings of it, that a run was not made with.

    Args:
        settings: of the run.
        new: as typed.

    Raises:
        InputError: a group names other code there.
    """
    for code in typed.typed_code():
        group, _, name = code.partition(".")
        shown = group if name == "make" and new[group]["name"] == "own" else code
        there, here = settings[group].get(name), new[group][name]
        if there != here:
            raise InputError(
                f"{shown}={here}: the run was made with {shown}="
                f"{there or settings[group]['name']}; type that, or leave {group} out"
            )
        for key, value in new[group].items():
            known = settings[group].get(key)
            if typed.was_typed(f"{group}.{key}") and value != known:
                raise InputError(
                    f"{group}.{key}={value}: the run was made with {group}.{key}={known}; "
                    f"leave {group}.{key} out"
                )


def check_groups(settings: Plain) -> None:
    """Make what the groups choose, where no table can check it: that takes the heavy imports.

    Raises:
        InputError: something cannot be made.
    """
    if open_groups(settings):
        from torchrl_pref.trial import check_groups

        check_groups(cast(Settings, settings))


def use_threads(settings: Mapping[str, Any]) -> None:
    """Set torch to the number of threads in the settings."""
    import torch

    torch.set_num_threads(settings["threads"])


def command(*arguments: str) -> str:
    """A line for the shell that runs this script, with this Python, as from where it was run."""
    python = "python" if shutil.which("python") == sys.executable else sys.executable
    return shlex.join([python, sys.argv[0], *arguments])


def as_typed(key: str, folder: Path) -> str:
    """``key=folder`` as Hydra is to be told it."""
    text = str(folder)
    if not re.fullmatch(r"[\w./-]*/[\w./-]*", text, re.ASCII):
        text = re.sub(r"(\\*)\$\{", r"\1\1\\${", text)  # no interpolation
        text = QuotedString(text, Quote.double).with_quotes()
    return f"{key}={text}"


def in_sweep() -> bool:
    """Whether this job is one of a sweep."""
    return bool(HydraConfig.get().mode == RunMode.MULTIRUN)


class Sweep(Callback):
    """Claims a sweep's folder before its first job, in the process that the user started."""

    folder: Path | None = None
    claim = contextlib.ExitStack()

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Refuse to mix two sweeps; begin the table."""
        folder = Path(os.path.abspath(config.hydra.sweep.dir))
        with one_line_errors():
            folder.mkdir(parents=True, exist_ok=True)
            Sweep.claim.enter_context(runs.claimed(folder))
            sweeps.write_table(folder)
        Sweep.folder = folder


@contextlib.contextmanager
def sweep_report() -> Iterator[None]:
    """At the end of a sweep, whatever ended it: its table, and what runs the missing jobs.

    Raises:
        InputError: the launcher gave up, or a job failed.
    """
    with Sweep.claim:
        try:
            yield
        except (KeyboardInterrupt, SystemExit):
            if Sweep.folder is not None:
                _report(Sweep.folder)
                print(f"go on with: {_sweep_again(Sweep.folder)}")
            raise
        except Exception as error:
            if Sweep.folder is None or isinstance(error, (HydraException, OmegaConfBaseException)):
                raise
            _report(Sweep.folder)
            raise InputError(
                f"the launcher gave up ({type(error).__name__}: {error}); run what is missing "
                f"with: {_sweep_again(Sweep.folder)}"
            ) from error
        if Sweep.folder is not None:
            failed = _report(Sweep.folder)
            if failed:
                raise InputError(
                    f"{', '.join(failed)}: failed, the table says why; once that is mended run "
                    f"what is missing with: {_sweep_again(Sweep.folder)}"
                )


def _report(sweep: Path) -> list[str]:
    """Write and print a sweep's table; returns the jobs that failed."""
    rows = sweeps.write_table(sweep)
    sweeps.show_table(sweep, rows)
    return [f"job {row['job']}" for row in rows if row.get("failed")]


def _sweep_again(sweep: Path) -> str:
    """The command of this sweep, for the same folder."""
    arguments = [a for a in sys.argv[1:] if not a.startswith("hydra.sweep.dir=")]
    return command(*arguments, as_typed("hydra.sweep.dir", sweep))


def do_job(work: Callable[[Path], float]) -> float:
    """Do a job in the folder that Hydra made for it; in a sweep others go on where it fails.

    Args:
        work: what is done, in that folder.
    """
    folder = output_folder()
    try:
        with unbroken_output(), one_line_errors():
            if in_sweep():
                sweep = Path(os.path.abspath(HydraConfig.get().sweep.dir))
                return sweeps.attempt(sweep, folder, typed.typed_overrides(), lambda: work(folder))
            return work(folder)
    finally:
        discard_if_empty(folder)


@contextlib.contextmanager
def resumable(folder: Path) -> Iterator[None]:
    """Where Ctrl-C or SIGTERM ends a run, say how to go on with it."""
    try:
        yield
    except KeyboardInterrupt as stop:
        if not in_sweep():
            print(f"\nstopped; go on with: {command(as_typed('resume', folder))}")
        raise SystemExit(exit_status(stop)) from None


def output_folder() -> Path:
    """The folder that Hydra made for this job."""
    return Path(HydraConfig.get().runtime.output_dir)


def discard_if_empty(folder: Path) -> None:
    """Remove the default folder of a sweep's job that left it empty, and the dated ones around it.

    A folder that the user named is theirs, and stays.
    """
    if not in_sweep() or not folder.is_relative_to(Path.cwd()):
        return
    inside = folder.relative_to(Path.cwd())
    if inside.parts[:1] in (("outputs",), ("multirun",)):
        with contextlib.suppress(OSError):
            for path in (inside, *list(inside.parents)[:-1]):
                path.rmdir()
