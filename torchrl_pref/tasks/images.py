"""The image files that scenes show, as the page of a study shows them (``study/static/scene.js``).

An image keeps its shape, whatever room there is. Where a scene is nothing but images they decide
its shape. An animated GIF moves with the frames of its scene, or makes them where there is one.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain
from pathlib import Path

from PIL import Image, ImageOps

from torchrl_pref.errors import InputError
from torchrl_pref.tasks.scene import Picture, Scene, Shape


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
            return image.height / image.width

    def at(self, picture: Picture, moment: int) -> Image.Image:
        """A frame of an image, the last one where it has fewer.

        Raises:
            InputError: see :meth:`count`.
        """
        with self._opened(picture) as image:
            image.seek(min(moment, _count(image) - 1))
            return image.convert("RGBA")

    @contextmanager
    def _opened(self, picture: Picture) -> Iterator[Image.Image]:
        path = picture.path
        try:
            image = self._animated.get(path)
            if image is None:
                file = io.BytesIO(Path(path).read_bytes())
                image = Image.open(file, formats=("PNG", "JPEG", "GIF"))
                ImageOps.exif_transpose(image, in_place=True)  # upright, as a browser shows it
                if _count(image) > 1:
                    self._animated[path] = image
            yield image
        except (OSError, EOFError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise InputError(
                f"{path}: cannot be shown ({error}); expected a PNG, JPEG or GIF"
            ) from None


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
    shapes: list[Shape] = [shape for scene in scenes for shape in chain(scene.still, *scene.frames)]
    pictures = [shape for shape in shapes if isinstance(shape, Picture)]
    if not pictures or len(pictures) < len(shapes):
        return list(scenes)
    high = max(images.aspect(picture) for picture in dict.fromkeys(pictures))
    return [replace(scene, low=(0.0, 0.0), high=(1.0, high), equal=True) for scene in scenes]
