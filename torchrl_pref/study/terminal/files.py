"""The open question as files beside a terminal: an animation or a picture of each option.

Letters: K options of a question.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from string import ascii_uppercase

from torchrl_pref.errors import one_line
from torchrl_pref.study.terminal.options import bars_of, files_of
from torchrl_pref.tasks.scene import Scene


class QuestionFiles:
    """Files of the open question, drawn while the person looks at it.

    Nothing of a question before is left once :meth:`show` returns: a file is of the open question,
    or it is not there yet.

    Args:
        folder: of the files; it is made where it is not there.

    Attributes:
        problem: why files of a question could not be written; None where they could.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.problem: str | None = None
        self._drawn: list[Path] = []
        self._lock, self._number = threading.Lock(), 0
        self._thread = ThreadPoolExecutor(1)
        self._work: Future[None] | None = None

    def show(self, scenes: Sequence[Scene]) -> list[Path]:
        """Begin to draw the options of a question.

        Args:
            scenes: K, at one scale.

        Returns:
            The files: ``A.gif`` and so on, or ``.png`` of what does not move; empty where text says
            all, as of features, or where there are image files already.
        """
        if self._work is not None:
            self._work.cancel()
        with self._lock:
            self._number += 1
            for path in self._drawn:
                with suppress(OSError):
                    path.unlink()
            self._drawn = []
        if any(files_of(scene) or bars_of(scene) is not None for scene in scenes):
            return []
        paths = [
            self.folder / f"{letter}.{'gif' if len(scene.frames) > 1 else 'png'}"
            for letter, scene in zip(ascii_uppercase, scenes, strict=False)
        ]
        self._work = self._thread.submit(self._draw, self._number, list(scenes), paths)
        return paths

    def close(self) -> None:
        """Finish what is being drawn."""
        self._thread.shutdown()

    def _draw(self, number: int, scenes: list[Scene], paths: list[Path]) -> None:
        """Draw the files, as long as the question is open."""
        from torchrl_pref.tasks.drawing import save_animation, save_picture  # takes its time

        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            for scene, path in zip(scenes, paths, strict=True):
                partial = path.with_name(f".next{path.suffix}")
                (save_animation if path.suffix == ".gif" else save_picture)(scene, partial)
                with self._lock:
                    if self._number != number:
                        partial.unlink()
                        return
                    os.replace(partial, path)
                    self._drawn.append(path)
            self.problem = None
        except (OSError, ValueError) as error:  # a full disk, or what no file can show
            self.problem = one_line(error)
