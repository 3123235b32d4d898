"""What the user typed: as Hydra composed it, checked before Hydra makes a folder for it."""

from __future__ import annotations

import argparse
import contextlib
import difflib
import os
import re
import shlex
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from help_text import CONF, keys_of
from torchrl_pref.config.checks import COST, PER_SECOND
from torchrl_pref.config.sections import CODE, Plain
from torchrl_pref.errors import InputError, one_line_errors

GROUPS = ("policy", "task", "question", "human", "belief")
"""Groups of which ``<group>=<module>:<name>`` chooses something of the user's own."""

CODE_KEYS = tuple(
    dict.fromkeys(f"{group}.{key}" for group in GROUPS for key in ("make", *CODE.get(group, ())))
)
"""Keys that name code of the user's, as ``<module>:<name>``."""


class Gate(Callback):
    """Refuses what was typed before Hydra makes a folder for it."""

    check: Callable[[Plain], None] | None = None
    """The script's own."""
    passed = False
    """Whether errors are no longer the input's."""
    made: tuple[Path, ...] = ()
    """The folders that Hydra makes for a single run, the innermost first."""

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Check the whole configuration."""
        with one_line_errors(), refusals():
            HydraConfig.instance().set_config(config)
            Gate._check_hydra(config)
            folder = _check_folder("hydra.run.dir", config.hydra.run.dir)
            if Gate.check is not None:
                Gate.check(plain_settings(config))
        Gate.made = tuple(path for path in (folder, *folder.parents) if not path.exists())

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Check where a sweep goes; each of its jobs checks its own configuration."""
        with one_line_errors(), refusals():
            Gate._check_hydra(config)
            _check_folder("hydra.sweep.dir", config.hydra.sweep.dir)

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        """From here on errors are a job's own."""
        Gate.passed = True

    @staticmethod
    def _check_hydra(config: DictConfig) -> None:
        """Refuse what of Hydra's own keys would change the meaning of ours."""
        if config.hydra.job.chdir:
            raise InputError(
                f"hydra.job.chdir={config.hydra.job.chdir}: paths are meant as from the folder "
                "that you are in; remove hydra.job.chdir"
            )
        inside = config.hydra.output_subdir
        if inside is not None and not re.fullmatch(r"[\w-][\w.-]{0,99}", inside):
            raise InputError(
                f"hydra.output_subdir={inside!r}: expected the name of a folder within that of the "
                "run, such as hydra.output_subdir=hydra, or null"
            )


def discard_folders() -> None:
    """Remove the folders that Hydra made for a single run, as far as nothing is in them."""
    with contextlib.suppress(OSError):
        for path in Gate.made:
            path.rmdir()


@contextlib.contextmanager
def refusals() -> Iterator[None]:
    """What Hydra cannot make a configuration of, as input that cannot be used.

    Raises:
        InputError: the input was at fault.
    """
    try:
        yield
    except (HydraException, OmegaConfBaseException) as error:
        text = re.sub(
            r"\.? (Config search path:|full_key:|To append to your config).*",
            "",
            " ".join(str(error).split()),
        )
        raise InputError(
            f"{_several(text) or text + _meant(text)}; --help lists the keys and their values"
        ) from None
    except Exception as error:
        if Gate.passed or isinstance(error, (InputError, OSError)):
            raise
        raise InputError(
            f"{shlex.join(sys.argv[1:])}: cannot be read ({type(error).__name__}: {error}); --help "
            "lists the keys and their values"
        ) from None


def _several(text: str) -> str | None:
    """What is wrong with several values outside a sweep; None where that is not it."""
    found = re.match(r"Ambiguous value for argument '([\w.+~/]+)=(.*?)'", text)
    if found is None:
        return None
    key, values = found.groups()
    return (
        f"{key}={values}: several values; expected -m before it, to run with each of them; or, of "
        f"what takes a list, brackets and quotes, as in '{key}=[{values}]'"
    )


def _meant(text: str) -> str:
    """What somebody may have meant, where Hydra says that there is no such key or choice."""
    choice = re.search(
        r"Could not find '(\w+)/([\w.]+)' Available options in '\w+': ([\w ]+)", text
    )
    if choice is not None:
        close = difflib.get_close_matches(choice[2], choice[3].split(), 1)
        return "".join(f"; did you mean {choice[1]}={name}?" for name in close)
    typed = re.search(r"Could not override '([\w.]+)'", text)
    if typed is None:
        return ""
    known = {
        key.name if path.parent == CONF else f"{path.parent.name}.{key.name}"
        for path in CONF.rglob("*.yaml")
        for key in keys_of(path)
        if key.name != "name"
    }
    known |= {key.partition(".")[0] for key in known}
    close = difflib.get_close_matches(typed[1], sorted(known), 1, 0.75)
    ends = [key for key in sorted(known) if key.endswith(f".{typed[1]}")]
    if typed[1] in known:
        return f"; {typed[1]} belongs to another choice than the one made here"
    return "".join(f"; did you mean {key}?" for key in (close or ends)[:1])


@contextlib.contextmanager
def checked_flags() -> Iterator[None]:
    """Say in one line what is wrong with a flag; refuse those that go past the checks.

    Raises:
        InputError: one of those was typed.
    """
    for argument in sys.argv[1:]:
        if argument.startswith("--e"):  # also where it is abbreviated
            raise InputError(
                f"{argument}: reruns are read from a pickle, which could run any code; type the "
                "settings again, or go on with a run by resume=<its folder>"
            )
        if argument.startswith(("-cn", "-cp", "--config-n", "--config-p")):
            raise InputError(
                f"{argument}: the configuration of this script is its own; settings of yours go "
                "into a file experiment/<name>.yaml, chosen by experiment=<name>, in conf or in "
                "the folder named by --config-dir"
            )

    def error(self: argparse.ArgumentParser, message: str) -> NoReturn:
        raise InputError(f"{message}; settings are typed as key=value, --help lists them")

    # Hydra's own parser, which nobody else is handed, would print its usage as well.
    before = argparse.ArgumentParser.error
    argparse.ArgumentParser.error = error  # type: ignore[method-assign]
    try:
        yield
    finally:
        argparse.ArgumentParser.error = before  # type: ignore[method-assign]


def told_hydra(arguments: list[str]) -> list[str]:
    """``policy=mine:make policy.width=9`` as Hydra is to be told it: the group's ``own``, what
    makes it, and settings that no file of ours knows."""
    code = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")
    pairs = [argument.partition("=") for argument in arguments]
    own = [group for group, _, value in pairs if group in GROUPS and code.fullmatch(value)]
    told: list[str] = []
    for argument, (key, _, value) in zip(arguments, pairs, strict=True):
        if key in own and code.fullmatch(value):
            told += [f"{key}=own", f"{key}.make={value}"]
        else:
            told.append(f"++{argument}" if key.partition(".")[0] in own else argument)
    return told


def plain_settings(config: DictConfig) -> Plain:
    """The composed configuration as plain values.

    Raises:
        InputError: a group was renamed from within.
    """
    own = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
    settings = OmegaConf.to_container(own, resolve=True)
    assert isinstance(settings, dict)
    choices = HydraConfig.get().runtime.choices
    for group in ("setup", "algorithm", *GROUPS):
        section, chosen = settings.get(group), choices.get(group)
        name = section.get("name", chosen) if isinstance(section, dict) else chosen
        if isinstance(chosen, str) and name != chosen:
            raise InputError(
                f"{group}.name={name!r}: type {group}={name} to choose another {group}"
            )
    return {str(key): value for key, value in settings.items()}


def typed_overrides() -> list[str]:
    """The keys=values that the user typed."""
    return list(HydraConfig.get().overrides.task)


def was_typed(key: str) -> bool:
    """Whether the user typed a value for a key."""
    return any(override.split("=")[0].lstrip("+") == key for override in typed_overrides())


def refuse_idle_cost(strategies: Sequence[str]) -> None:
    """Refuse seconds that were typed for strategies none of which counts them.

    Raises:
        InputError: they were.
    """
    idle = [key for key in COST if was_typed(key)]
    if idle and not set(PER_SECOND) & set(strategies):
        raise InputError(
            f"{idle[0]}: no strategy here counts the seconds of a question; expected "
            f"{' or '.join(f'strategy={name}' for name in PER_SECOND)}; type one, or remove "
            f"{idle[0]}"
        )


def typed_code() -> list[str]:
    """The keys by which the user typed what code of theirs may be imported."""
    return [key for key in CODE_KEYS if was_typed(key)]


def refuse_other_overrides(
    source: str, allowed: tuple[str, ...], own: tuple[str, ...] = ()
) -> None:
    """Refuse to ignore what the user typed where a checkpoint decides.

    Args:
        source: the key that names the checkpoint.
        allowed: keys, or sections ending in a dot, that may be typed beside it.
        own: groups of which the user brings what is chosen.

    Raises:
        InputError: another key was typed.
    """
    for override in typed_overrides():
        key = override.split("=")[0].lstrip("+~")
        named = key.partition(".")[0] in own
        if key != source and not key.startswith(allowed) and not named:
            raise InputError(
                f"{override}: {source}=… brings its own settings and only "
                f"{', '.join(allowed)} may be typed beside it; remove {key}, or drop {source}"
            )


def _check_folder(key: str, value: str) -> Path:
    """The absolute path of a folder in which files may be written.

    Raises:
        InputError: it is the present folder or around it, or it cannot be made.
    """
    folder, here = Path(os.path.abspath(value)), Path.cwd()
    if not value.strip() or folder == here or folder in here.parents:
        raise InputError(
            f"{key}={value!r}: that is the folder that you are in, or one around it; expected a "
            f"folder for this alone, such as {key}=outputs/first"
        )
    if not value.isprintable() or any(len(os.fsencode(part)) > 255 for part in folder.parts):
        raise InputError(f"{key}={value!r}: no folder can have this name; choose another")
    nearest = next(path for path in (folder, *folder.parents) if path.exists())
    try:
        with tempfile.TemporaryFile(dir=nearest):
            return folder
    except OSError as error:
        raise InputError(
            f"{key}={value}: the run folder cannot be written ({nearest}: {error.strerror}); set "
            f"{key} to a folder that can be"
        ) from None
