"""What train.py and evaluate.py share: everything that touches Hydra."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from torchrl_pref.errors import InputError, check_count, one_line_errors


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
        except OSError as error:
            raise InputError(
                f"{error.filename}: the run folder cannot be written ({error.strerror}); "
                "set hydra.run.dir to a folder that can be"
            ) from None


def plain_settings(config: DictConfig) -> dict[str, Any]:
    """The composed configuration as plain values, and torch set to its number of threads."""
    settings = OmegaConf.to_container(config, resolve=True)
    assert isinstance(settings, dict)
    torch.set_num_threads(check_count("threads", settings["threads"], 1))
    return {str(key): value for key, value in settings.items()}


def typed_overrides() -> list[str]:
    """The keys=values that the user typed."""
    return list(HydraConfig.get().overrides.task)


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
    """Remove the folder of a job that left nothing in it, and parents that are empty then."""
    with contextlib.suppress(OSError):
        os.removedirs(folder)
