"""Features of trajectories from a file: NPZ, CSV, Parquet or Safetensors.

Letters: N trajectories or queries, K options per query, D features.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_pref.errors import InputError
from torchrl_pref.storage.tables import read_columns
from torchrl_pref.tasks.recorded import RecordedTask
from torchrl_pref.tasks.scene import Picture, Scene
from torchrl_pref.tensors import check_names

IMAGES = (".png", ".jpg", ".jpeg", ".gif")


class FilesTask(RecordedTask):
    """Trajectories of which a file holds the features, a column each.

    Args:
        path: of the file, see ``storage.tables`` for what may be in it.
        columns: which columns are features; None: all but ``images``.
        images: the column that names an image of each trajectory, as from the file's folder; None:
            people are shown the features.

    Raises:
        InputError: the file cannot be read, or a column is missing, not numeric or not finite.
    """

    def __init__(
        self,
        path: str | None = None,
        columns: list[str] | None = None,
        images: str | None = None,
    ) -> None:
        if path is None:
            raise InputError("path=null: expected the file of the trajectories; type path=…")
        _check_columns(columns, images)
        found = read_columns(path, columns, images)
        self._pictures = None if images is None else _pictures(Path(path), found.pop(images))
        if len(found) < 2:
            raise InputError(
                f"{path}: {len(found)} columns of features ({', '.join(found)}); expected two or "
                "more; an array (N D) or (N K D) is to be called features"
            )
        names = check_names(list(found), len(found))
        features = torch.from_numpy(np.stack(list(found.values()), -1))
        del found  # which has taken as much again
        super().__init__(str(path), features, names)

    def scene(self, trajectory: Tensor) -> Scene:
        """See :meth:`Task.scene`: its image, where there is one."""
        if self._pictures is None:
            return super().scene(trajectory)
        picture = Picture(self._pictures[int(trajectory)])
        return Scene((0.0, 0.0), (1.0, 1.0), (), ((picture,),))


def _check_columns(columns: Any, images: Any) -> None:
    """Refuse what names no columns.

    Raises:
        InputError: it does not.
    """
    if columns is not None and (
        not isinstance(columns, list) or not all(isinstance(name, str) for name in columns)
    ):
        raise InputError(f"columns={columns!r}: expected a list of names, such as [speed,lane]")
    if images is not None and (not isinstance(images, str) or images in (columns or ())):
        raise InputError(f"images={images!r}: expected the name of a column that is no feature")
    if columns is not None and len(set(columns)) < len(columns):
        raise InputError(f"columns={columns!s:.200}: names one twice; remove one of them")


def _pictures(path: Path, named: np.ndarray) -> list[str]:
    """Absolute paths (N), or (N K) one after another, of the images that a column names.

    Raises:
        InputError: one is not there, is no image, or lies outside of the file's folder.
    """
    folder = path.resolve().parent
    # A few images may be named millions of times: each is looked for once.
    found = {name: _picture(path, folder, name) for name in dict.fromkeys(named.flat)}
    return [found[name] for name in named.flat]


def _picture(path: Path, folder: Path, name: str) -> str:
    """The absolute path of an image that a file names, as from its folder.

    Raises:
        InputError: it is not there, is no image, or lies outside of the folder.
    """
    try:
        picture = (folder / name).resolve()
        there = picture.is_file() and picture.is_relative_to(folder)
    except (OSError, ValueError):  # what no file can be called
        there = False
    if not there or picture.suffix.lower() not in IMAGES:
        raise InputError(
            f"{path}: names the image {name!r:.200}; expected a file ({', '.join(IMAGES)}) in "
            f"{folder} or below it"
        )
    return sys.intern(str(picture))  # many names may be of one image
