"""Scenes as plain JSON, for a page to draw.

Letters: K options of a question.
"""

from __future__ import annotations

from functools import lru_cache
from hashlib import sha256
from typing import Any

from torchrl_pref.study.materials import Materials
from torchrl_pref.tasks.scene import Picture, Shape

DIGITS = 5
"""Of a coordinate: more than a screen can show."""


KEPT = 200
"""Scenes that are kept as JSON: those of questions that may come next, for some people."""


class Scenes:
    """Scenes of the pool's options as plain JSON, and the image files that these show: nobody can
    ask for another.

    A file has the same name for as long as a study lasts, however often it is begun again, as pages
    that are still open know it.

    Args:
        materials: of the study.
    """

    def __init__(self, materials: Materials) -> None:
        self._materials = materials
        self._paths: dict[str, str] = {}
        self.of = lru_cache(KEPT)(self._of)

    def _of(self, query: int, option: int) -> dict[str, Any]:
        """What a page draws of an option: the fields of its scene, each shape with its kind."""
        scene = self._materials.scene(query, option)
        return {
            "low": _rounded(scene.low),
            "high": _rounded(scene.high),
            "equal": scene.equal,
            "still": [self._shape(shape) for shape in scene.still],
            "frames": [[self._shape(shape) for shape in frame] for frame in scene.frames],
        }

    def _shape(self, shape: Shape) -> dict[str, Any]:
        kind = type(shape).__name__.lower()
        if isinstance(shape, Picture):
            name = sha256(shape.path.encode()).hexdigest()[:16]
            self._paths[name] = shape.path
            return {"kind": kind, "url": f"/api/picture/{name}"}
        return {"kind": kind, **{key: _rounded(value) for key, value in vars(shape).items()}}

    def path(self, name: str) -> str | None:
        """The image file of a name; None where there is none."""
        return self._paths.get(name)


def _rounded(value: Any) -> Any:
    """Numbers of few digits, in lists of any depth; anything else as it is."""
    if isinstance(value, tuple | list):
        return [_rounded(one) for one in value]
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}")
    return value
