"""Scenes as files: a picture or an animation of a trajectory, or of the options of a question.

Shapes: K options of a question, T frames. Sizes on paper are in inches.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon
from PIL import Image

from torchrl_pref.errors import InputError
from torchrl_pref.storage.writing import replacing
from torchrl_pref.tasks.images import Images, frame_count, shaped
from torchrl_pref.tasks.scene import Disc, Label, Line, Patch, Picture, Point, Scene, Shape, corners

Scenes: TypeAlias = Scene | Sequence[Scene]
"""Of one trajectory, or of the options of a question, which are shown side by side."""

Box: TypeAlias = tuple[Point, Point]
"""The corners of what is seen."""

LETTERS = "ABCDEFGH"
"""Of the options."""

MOST_FRAMES = 60
SECONDS, LAST = 4.0, 1.5
"""That an animation takes, and that its last frame is seen."""

DPI = 110
AREA = 8.0
"""Square inches of one trajectory."""
MARGIN, HEADING = 0.12, 0.26
"""Around a panel, and of the letter above it."""


def save_picture(scenes: Scenes, path: str | Path) -> None:
    """Write a picture of whole trajectories: what does not move, and the last frame.

    Args:
        scenes: of one trajectory, or of K options, 8 at most.
        path: ends in ``.png`` or ``.svg``.

    Raises:
        InputError: there are too many options, an image of theirs cannot be read, or the file has
            another ending or cannot be written.
    """
    path = checked(path, ".png", ".svg")
    save_figure(picture_of(scenes), path)


def picture_of(scenes: Scenes) -> Figure:
    """A picture of whole trajectories, see :func:`save_picture`."""
    images = Images()
    figure, panels = row_of(scenes, images)
    for axes, scene in panels:
        draw_end(axes, scene, images)
    return figure


def save_animation(scenes: Scenes, path: str | Path) -> None:
    """Write an animation of some four seconds, which begins again and again.

    Args:
        scenes: of one trajectory, or of K options, 8 at most; one that is shorter stays at its end.
        path: ends in ``.gif``. Of more than 60 frames an even choice is shown, of animated images
            as of scenes.

    Raises:
        InputError: there are too many options, an image of theirs cannot be read, or the file has
            another ending or cannot be written.
    """
    path = checked(path, ".gif")
    shown, seen = Images(), []
    figure, panels = row_of(scenes, shown)
    length = max(frame_count(scene, shown) for _, scene in panels)
    count = min(length, MOST_FRAMES)
    for number in range(count):
        step = round(number * (length - 1) / max(1, count - 1))
        drawn: list[Artist] = []
        for axes, scene in panels:
            frame = scene.frames[min(step, len(scene.frames) - 1)]
            drawn += draw(axes, frame, scene, shown, step)
        seen.append(as_image(figure))
        for artist in drawn:
            artist.remove()
    palette = palette_of(seen)
    first, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in seen)
    each = [min(400, round(1000 * SECONDS / count))] * (count - 1)
    durations = [*each, round(1000 * LAST)]
    file = io.BytesIO()
    first.save(file, "GIF", save_all=True, append_images=others, duration=durations, loop=0)
    write(path, file)


def palette_of(images: Sequence[Image.Image]) -> Image.Image:
    """One choice of colours for frames of one size, or the ground would flicker: by all of the last
    one, and the others made small."""
    *others, last = images
    small = max(1, last.width // 4), max(1, last.height // 4)
    rows = -(-len(others) // 4)
    whole = Image.new("RGB", (last.width, last.height + rows * small[1]), "white")
    whole.paste(last)
    for number, image in enumerate(others):
        place = (number % 4 * small[0], last.height + number // 4 * small[1])
        whole.paste(image.resize(small, Image.Resampling.NEAREST), place)
    return whole.quantize(128, dither=Image.Dither.NONE)


def checked(path: str | Path, *endings: str) -> Path:
    """The path of a file that is to be written.

    Raises:
        InputError: it has another ending.
    """
    path = Path(path)
    if path.suffix.lower() not in endings:
        raise InputError(f"{path}: expected a name that ends in {' or '.join(endings)}")
    return path


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure, by the ending of the file."""
    kind, file = path.suffix.lower().removeprefix("."), io.BytesIO()
    # Neither the time nor names drawn by chance: the same picture is the same file.
    date = {"Date": None} if kind == "svg" else None
    with rc_context({"svg.hashsalt": "scene"}):
        figure.savefig(file, format=kind, metadata=date)
    write(path, file)


def write(path: Path, file: io.BytesIO) -> None:
    """Write what was made, whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    try:
        with replacing(path) as partial:
            partial.write_bytes(file.getbuffer())
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror}); name a file in a folder that is there"
        ) from None


def row_of(scenes: Scenes, images: Images) -> tuple[Figure, list[tuple[Axes, Scene]]]:
    """A figure with a panel for each option, at one scale, and in it what does not move.

    Raises:
        InputError: there are too many options.
    """
    options = [scenes] if isinstance(scenes, Scene) else list(scenes)
    if not 1 <= len(options) <= len(LETTERS):
        raise InputError(f"{len(options)} trajectories: expected 1 to {len(LETTERS)} side by side")
    options = shaped(options, images)
    box = corners(options)
    width, height = panel_size(aspect_of(box, options[0].equal), AREA)
    above = HEADING if len(options) > 1 else 0.0
    whole = (len(options) * (width + MARGIN) + MARGIN, height + 2 * MARGIN + above)
    figure = Figure(whole, DPI)
    FigureCanvasAgg(figure)
    panels = []
    for number, scene in enumerate(options):
        left = MARGIN + number * (width + MARGIN)
        axes = panel(figure, (left, MARGIN, width, height), scene, box, images)
        if above:
            axes.set_title(LETTERS[number], fontsize=12, fontweight="bold", pad=4)
        panels.append((axes, scene))
    return figure, panels


def aspect_of(box: Box, equal: bool) -> float:
    """Height of a panel over its width."""
    (left, low), (right, high) = box
    return (high - low) / (right - left) if equal else 0.75


def panel_size(aspect: float, area: float) -> tuple[float, float]:
    """Width and height of a panel, of a shape that a page can hold."""
    width = math.sqrt(area / min(8.0, max(1 / 8, aspect)))
    return width, width * aspect


def panel(
    figure: Figure,
    place: tuple[float, float, float, float],
    scene: Scene,
    box: Box,
    images: Images,
) -> Axes:
    """Axes without ticks, with what does not move of a scene.

    Args:
        figure: what they are put into.
        place: left, low, width and height; where units are equal, of the shape of ``box``.
        scene: the trajectory's.
        box: what is seen.
        images: those that it shows.
    """
    axes = axes_at(figure, place)
    (left, low), (right, high) = box
    axes.set(xlim=(left, right), ylim=(low, high), xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set(color="#bbbbbb", linewidth=0.8, zorder=2)
    draw(axes, scene.still, scene, images)
    return axes


def axes_at(figure: Figure, place: tuple[float, float, float, float]) -> Axes:
    """Axes at a place in inches."""
    across, up = figure.get_size_inches()
    left, low, width, height = place
    return figure.add_axes((left / across, low / up, width / across, height / up))


def draw_end(axes: Axes, scene: Scene, images: Images) -> None:
    """Draw the last frame of a scene."""
    draw(axes, scene.frames[-1], scene, images, frame_count(scene, images) - 1)


def draw(
    axes: Axes, shapes: Sequence[Shape], scene: Scene, images: Images, moment: int = 0
) -> list[Artist]:
    """Draw shapes of a scene on top of what is there; what is returned can be removed again.

    Args:
        axes: the scene's panel.
        shapes: of the scene.
        scene: where they are of.
        images: those that it shows.
        moment: which frame of animated images.
    """
    drawn = [
        _image(axes, images.at(shape, moment), scene)
        if isinstance(shape, Picture)
        else _artist(axes, shape)
        for shape in shapes
    ]
    for artist in drawn:
        artist.set(zorder=1, clip_on=True)  # of equals, the later is on top
    return drawn


def _artist(axes: Axes, shape: Line | Patch | Disc | Label) -> Artist:
    """One shape, drawn."""
    match shape:
        case Line():
            xs, ys = zip(*shape.points, strict=True)
            line = Line2D(xs, ys, linewidth=shape.width, color=shape.colour)
            line.set_linestyle("--" if shape.dashed else "-")
            return axes.add_line(line)
        case Patch():
            return axes.add_patch(Polygon(shape.points, facecolor=shape.colour, linewidth=0))
        case Disc():
            return axes.add_patch(Circle(shape.centre, shape.radius, color=shape.colour, lw=0))
        case Label():
            text = axes.text(*shape.at, shape.text, color=shape.colour, parse_math=False)
            text.set(fontsize=8, ha="center", va="center")
            return text


def _image(axes: Axes, image: Image.Image, scene: Scene) -> Artist:
    """An image in the middle of its scene, as large as there is room for all of it."""
    (left, low), (right, high) = scene.low, scene.high
    # Pixels of the figure that a unit of the scene takes.
    across, up = axes.bbox.width / _span(axes.get_xlim()), axes.bbox.height / _span(axes.get_ylim())
    scale = min((right - left) * across / image.width, (high - low) * up / image.height)
    x, y = (left + right) / 2, (low + high) / 2
    half, rise = image.width * scale / across / 2, image.height * scale / up / 2
    return axes.imshow(image, extent=(x - half, x + half, y - rise, y + rise), aspect="auto")


def _span(limits: tuple[float, float]) -> float:
    """From one to the other."""
    return limits[1] - limits[0]


def as_image(figure: Figure) -> Image.Image:
    """A figure as pixels."""
    canvas = figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    canvas.draw()
    return Image.frombytes("RGBA", canvas.get_width_height(), canvas.buffer_rgba()).convert("RGB")
