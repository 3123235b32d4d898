"""The image files that scenes show, as the page of a study shows them (``study/static/scene.js``).

An image keeps its shape, whatever room there is. Where a scene is nothing but images they decide
its shape. An animated GIF moves with the frames of its scene, or makes them where there is one.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from PIL import ExifTags, Image

from torchrl_pref.errors import InputError
from torchrl_pref.tasks.scene import Picture, Scene


class Images:
    """Image files while something is drawn; of an animated one each frame is made once."""

    def __init__(self) -> None:
        self._animated: dict[str, Image.Image] = {}

    def count(self, picture: Picture) -> int:
        """How many frames an image has.

        Raises:
            InputError: it is missing, or no PNG, JPEG or GIF that can be read.
        """
        with self._opened(picture) as image:
            return _count(image)

    def aspect(self, picture: Picture) -> float:
        """Height of an image over its width.

        Raises:
            InputError: see :meth:`count`.
        """
        with self._opened(picture) as image:
            across, up = image.size
            return across / up if _turned(image) in LYING else up / across

    def at(self, picture: Picture, moment: int) -> Image.Image:
        """A frame of an image, the last one where it has fewer.

        Raises:
            InputError: see :meth:`count`.
        """
        with self._opened(picture) as image:
            image.seek(min(moment, _count(image) - 1))
            shown, turn = image.convert("RGBA"), TURNS.get(_turned(image))
            return shown if turn is None else shown.transpose(turn)

    @contextmanager
    def _opened(self, picture: Picture) -> Iterator[Image.Image]:
        path = picture.path
        try:
            image = self._animated.get(path)
            if image is None:
                file = io.BytesIO(Path(path).read_bytes())
                with warnings.catch_warnings(action="ignore", category=UserWarning):
                    image = Image.open(file, formats=("PNG", "JPEG", "GIF"))
                if _count(image) > 1:
                    self._animated[path] = image
            yield image
        except (OSError, EOFError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise InputError(
                f"{path}: cannot be shown ({error}); expected a PNG, JPEG or GIF"
            ) from None


TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""How a photograph is turned back, by what its camera wrote of itself (EXIF), as browsers do."""

LYING = (5, 6, 7, 8)
"""Of these width and height change places."""


def _turned(image: Image.Image) -> Any:
    """How a camera was held; None where the file does not say, or not so that it can be read."""
    with warnings.catch_warnings(action="ignore", category=UserWarning):
        try:
            return image.getexif().get(ExifTags.Base.Orientation)
        except Exception:  # of many kinds where the tags are damaged; the picture may be whole
            return None


def _count(image: Image.Image) -> int:
    """Frames of a GIF; of others the first one is shown alone."""
    return int(getattr(image, "n_frames", 1)) if image.format == "GIF" else 1


def frame_count(scene: Scene, images: Images) -> int:
    """How many frames are seen of a scene, with those of its images where it has but one."""
    if len(scene.frames) > 1:
        return len(scene.frames)
    shown = (shape for shape in scene.frames[0] if isinstance(shape, Picture))
    return max((images.count(picture) for picture in shown), default=1)


def shaped(scenes: Sequence[Scene], images: Images) -> list[Scene]:
    """The options of a question, of the shape of the highest image where there is nothing else."""
    shapes = [shape for scene in scenes for shape in scene.shapes]
    pictures = [shape for shape in shapes if isinstance(shape, Picture)]
    if not pictures or len(pictures) < len(shapes):
        return list(scenes)
    high = max(images.aspect(picture) for picture in dict.fromkeys(pictures))
    return [replace(scene, low=(0.0, 0.0), high=(1.0, high), equal=True) for scene in scenes]
