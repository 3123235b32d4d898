"""What train.py and evaluate.py share: everything that touches Hydra."""

from __future__ import annotations

import contextlib
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from torchrl_pref.errors import InputError, check_count, one_line_errors

SECTIONS = {"grid", "pool", "belief", "evaluation", "training", "setup", "policy"}


def main(job: Callable[[], Any]) -> None:
    """Run a Hydra job; input that cannot be used ends it with one line and status 2."""
    # Without this Hydra prints its own several lines and exits with status 1.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    with one_line_errors():
        try:
            job()
        except (HydraException, OmegaConfBaseException) as error:
            text = " ".join(str(error).split())
            text = re.sub(
                r"\.? (Config search path:|full_key:|To append to your config).*", "", text
            )
            raise InputError(f"{text}; --help lists the keys and their values") from None
        except KeyboardInterrupt:
            print("\nstopped", file=sys.stderr)
            raise SystemExit(130) from None
        except OSError as error:
            raise InputError(
                f"{error.filename}: the run folder cannot be written ({error.strerror}); "
                "set hydra.run.dir to a folder that can be"
            ) from None


def plain_settings(config: DictConfig) -> dict[str, Any]:
    """The composed configuration as plain values.

    Raises:
        InputError: a section was replaced by a value, or a group was renamed from within.
    """
    settings = OmegaConf.to_container(config, resolve=True)
    assert isinstance(settings, dict)
    choices = HydraConfig.get().runtime.choices
    for section in SECTIONS & set(settings):
        if not isinstance(settings[section], dict):
            raise InputError(
                f"{section}={settings[section]!r}: {section} is a section of keys and not a value; "
                f"type {section}.<key>=<value>, --help lists them"
            )
    for group in ("setup", "policy"):
        chosen = choices.get(group)
        if chosen is not None and settings[group]["name"] != chosen:
            name = settings[group]["name"]
            raise InputError(
                f"{group}.name={name!r}: type {group}={name} to choose another {group}"
            )
    return {str(key): value for key, value in settings.items()}


def use_threads(settings: dict[str, Any]) -> None:
    """Set torch to the number of threads in the settings."""
    torch.set_num_threads(check_count("threads", settings["threads"], 1))


def typed_overrides() -> list[str]:
    """The keys=values that the user typed."""
    return list(HydraConfig.get().overrides.task)


def was_typed(key: str) -> bool:
    """Whether the user typed a value for a key."""
    return any(override.split("=")[0].lstrip("+") == key for override in typed_overrides())


def refuse_other_overrides(source: str, allowed: tuple[str, ...]) -> None:
    """Refuse to ignore what the user typed where a checkpoint decides.

    Args:
        source: the key that names the checkpoint.
        allowed: keys, or sections ending in a dot, that may be typed beside it.

    Raises:
        InputError: another key was typed.
    """
    for override in typed_overrides():
        key = override.split("=")[0].lstrip("+~")
        if key != source and not key.startswith(allowed):
            raise InputError(
                f"{override}: {source}=… brings its own settings and only "
                f"{', '.join(allowed)} may be typed beside it; remove {key}, or drop {source}"
            )


def output_folder() -> Path:
    """The folder that Hydra made for this job."""
    return Path(HydraConfig.get().runtime.output_dir)


def discard_if_empty(folder: Path) -> None:
    """Remove a default folder that the job left empty, and the dated ones around it.

    A folder that the user named is theirs, and stays.
    """
    try:
        inside = folder.relative_to(Path.cwd())
    except ValueError:
        return
    if inside.parts[0] in ("outputs", "multirun"):
        with contextlib.suppress(OSError):
            for path in (inside, *list(inside.parents)[:-1]):
                path.rmdir()
