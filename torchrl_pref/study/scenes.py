"""Scenes as plain JSON, for a page to draw.

Letters: K options of a question.
"""

from __future__ import annotations

from hashlib import sha256
from typing import Any

from torchrl_pref.tasks.scene import Picture, Scene, Shape

DIGITS = 5
"""Of a coordinate: more than a screen can show."""


class Pictures:
    """The image files that the scenes of a study show: nobody can ask for another.

    A file has the same name for as long as a study lasts, however often it is begun again, as pages
    that are still open know it.
    """

    def __init__(self) -> None:
        self._paths: dict[str, str] = {}

    def name(self, path: str) -> str:
        """What an image file is asked for by."""
        name = sha256(path.encode()).hexdigest()[:16]
        self._paths[name] = path
        return name

    def path(self, name: str) -> str | None:
        """The file of a name; None where there is none."""
        return self._paths.get(name)


def scene_as_json(scene: Scene, pictures: Pictures) -> dict[str, Any]:
    """What a page draws of a trajectory: the fields of the scene, each shape with its kind."""
    return {
        "low": _rounded(scene.low),
        "high": _rounded(scene.high),
        "equal": scene.equal,
        "still": [_shape(shape, pictures) for shape in scene.still],
        "frames": [[_shape(shape, pictures) for shape in frame] for frame in scene.frames],
    }


def _shape(shape: Shape, pictures: Pictures) -> dict[str, Any]:
    kind = type(shape).__name__.lower()
    if isinstance(shape, Picture):
        return {"kind": kind, "url": f"/api/picture/{pictures.name(shape.path)}"}
    return {"kind": kind, **{key: _rounded(value) for key, value in vars(shape).items()}}


def _rounded(value: Any) -> Any:
    """Numbers of few digits, in lists of any depth; anything else as it is."""
    if isinstance(value, tuple | list):
        return [_rounded(one) for one in value]
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}")
    return value
