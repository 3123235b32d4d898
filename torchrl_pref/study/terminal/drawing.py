"""A trajectory as letters: what somebody in a terminal sees of a scene.

A cell of the terminal is twice as high as it is wide. Fills give cells their shade, or in colour
their ground; on them lines and what moves are drawn in Braille patterns, of two by four dots.

Shapes: T frames.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from itertools import product
from statistics import fmean
from typing import NamedTuple, TypeAlias

import numpy as np
from PIL import Image, ImageColor, ImageDraw

from torchrl_pref.tasks.scene import Disc, Label, Line, Patch, Picture, Point, Scene, Shape

Colour: TypeAlias = tuple[int, int, int]

ACROSS, UP = 2, 4
"""Dots of a cell."""

PATTERN = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
"""What the dots of a cell add to the number of a Braille pattern."""

MARKS = (("○", "●"), ("□", "■"), ("△", "▲"), ("◇", "◆"))
"""Where each of the things that move starts, and where it is."""

SHADES = ((0.17, " "), (0.22, "░"), (0.27, "▒"), (1.0, "▓"))
"""Of a fill without colour, by how dark it is at most."""

PAPER, GREY = (255, 255, 255), (85, 85, 85)

FARTHEST = 1e4
"""Dots from the corner that anything is drawn to."""

DASH = 3
"""Dots of a dash, and of what is left out after it."""


class Size(NamedTuple):
    """Of a drawing, in cells."""

    columns: int
    rows: int


class Cell(NamedTuple):
    """A letter of a drawing; a blank where nothing but the ground is seen."""

    letter: str
    colour: Colour
    ground: Colour


def draw(scene: Scene, size: Size, step: int | None = None) -> list[list[Cell]]:
    """Draw a trajectory.

    Args:
        scene: of the trajectory; pictures in it are left out.
        size: of the drawing.
        step: the frame that is shown, 0 to T-1; None: the last, and where everything started.

    Returns:
        Cells by row and column.
    """
    drawing = Drawing(size, scene.low, scene.high)
    for shape in scene.still:
        if isinstance(shape, Patch | Disc):
            drawing.fill(shape)
        else:
            drawing.ink(shape)
    ways = ways_of(scene)
    for way, colour in ways:
        drawing.ink(Line(way, colour))
    now = -1 if step is None else step
    for shape in scene.frames[now]:
        drawing.ink(shape)
    for (way, colour), (start, here) in zip(ways, MARKS * len(ways), strict=False):
        if step is None:
            drawing.write(way[0], start, colour)
        drawing.write(way[now], here, colour)
    return drawing.cells()


def ways_of(scene: Scene) -> list[tuple[tuple[Point, ...], str]]:
    """T points and a colour for each shape that moves: where its middle is."""
    found = []
    for shapes in zip(*scene.frames, strict=False):
        way = tuple(middle for shape in shapes if (middle := _middle(shape)) is not None)
        last = shapes[-1]
        if len(way) == len(shapes) and len(set(way)) > 1 and not isinstance(last, Picture):
            found.append((way, last.colour))
    return found


def _middle(shape: Shape) -> Point | None:
    match shape:
        case Disc():
            return shape.centre
        case Line() | Patch():
            xs, ys = zip(*shape.points, strict=True)
            return fmean(xs), fmean(ys)
        case _:
            return None


class Drawing:
    """What is drawn so far.

    Args:
        size: in cells.
        low, high: corners of what is seen.
    """

    def __init__(self, size: Size, low: Point, high: Point) -> None:
        self._size, self._low, self._high = size, low, high
        dots = (size.columns * ACROSS, size.rows * UP)
        self._ground, self._ink = Image.new("RGB", dots, PAPER), Image.new("RGB", dots)
        self._inked = Image.new("L", dots)
        self._letters: dict[tuple[int, int], tuple[str, Colour]] = {}

    def fill(self, shape: Patch | Disc) -> None:
        """Colour the ground."""
        self._shape(self._ground, shape, _rgb(shape.colour))

    def ink(self, shape: Shape) -> None:
        """Draw in dots."""
        if isinstance(shape, Label):
            self.write(shape.at, shape.text, shape.colour)
        elif not isinstance(shape, Picture):
            self._shape(self._ink, shape, _rgb(shape.colour))
            self._shape(self._inked, shape, 255)

    def write(self, at: Point, text: str, colour: str) -> None:
        """Put letters around a point, or beside it at an edge."""
        text = "".join(one if one.isprintable() else "?" for one in text)[: self._size.columns]
        ((x, y),) = self._dots([at])
        row = min(self._size.rows - 1, max(0, int(y) // UP))
        left = round((x + 0.5) / ACROSS - len(text) / 2)
        left = min(self._size.columns - len(text), max(0, left))
        for column, letter in enumerate(text, left):
            self._letters[row, column] = letter, _rgb(colour)

    def cells(self) -> list[list[Cell]]:
        """The drawing, by row and column."""
        ground, ink, inked = map(self._by_cell, (self._ground, self._ink, self._inked))
        patterns = ((inked[..., 0] > 0) * PATTERN.flatten()).sum(-1)
        return [
            [
                self._cell(row, column, ground[row, column], ink[row, column], int(pattern))
                for column, pattern in enumerate(line)
            ]
            for row, line in enumerate(patterns)
        ]

    def _cell(
        self, row: int, column: int, ground: np.ndarray, ink: np.ndarray, pattern: int
    ) -> Cell:
        letter, colour = self._letters.get((row, column), (" ", PAPER))
        if letter == " " and pattern:
            inked = ink[(pattern & PATTERN.flatten()) > 0]
            colours, counts = np.unique(inked, axis=0, return_counts=True)
            letter, colour = chr(0x2800 + pattern), _tuple(colours[counts.argmax()])
        return Cell(letter, colour, _tuple(ground.mean(0)))

    def _by_cell(self, image: Image.Image) -> np.ndarray:
        """(rows columns dots channels) of an image."""
        columns, rows = self._size
        dots = np.asarray(image).reshape(rows, UP, columns, ACROSS, -1)
        return dots.transpose(0, 2, 1, 3, 4).reshape(rows, columns, ACROSS * UP, -1)

    def _shape(self, image: Image.Image, shape: Shape, colour: Colour | int) -> None:
        pen = ImageDraw.Draw(image)
        match shape:
            case Patch():
                pen.polygon(self._dots(shape.points), fill=colour)
            case Line():
                dots = self._dots(shape.points)
                for part in _dashes(dots) if shape.dashed else [dots]:
                    pen.line(part, fill=colour)
            case Disc():
                (x, y), far = shape.centre, abs(shape.radius)
                pen.ellipse(self._dots([(x - far, y + far), (x + far, y - far)]), fill=colour)

    def _dots(self, points: Iterable[Point]) -> list[tuple[float, float]]:
        """Points, in dots from the upper left."""
        (left, low), (right, high) = self._low, self._high
        columns, rows = self._size
        given = np.array(list(points), dtype=float)
        wide, tall = max(right - left, 1e-9), max(high - low, 1e-9)
        shares = (given - (left, high)) / (wide, -tall)
        dots = shares * (columns * ACROSS, rows * UP) - 0.5
        near = np.clip(np.nan_to_num(dots), -FARTHEST, FARTHEST)
        return [(x, y) for x, y in near.round().tolist()]


def _dashes(dots: list[tuple[float, float]]) -> list[list[tuple[float, float]]]:
    """A line in pieces."""
    across, down = np.array(dots).T
    along = np.concatenate([[0.0], np.hypot(np.diff(across), np.diff(down)).cumsum()])
    starts = np.arange(0, along[-1], 2 * DASH)
    ends = np.minimum(starts + DASH - 1, along[-1])
    begin, end = (
        zip(np.interp(at, along, across).tolist(), np.interp(at, along, down).tolist(), strict=True)
        for at in (starts, ends)
    )
    return [list(piece) for piece in zip(begin, end, strict=True)]


def _rgb(colour: str) -> Colour:
    """A colour by its code or its name; grey where it has another name."""
    try:
        red, green, blue = ImageColor.getrgb(colour)[:3]
    except ValueError:
        return GREY
    return red, green, blue


def _tuple(colour: np.ndarray) -> Colour:
    red, green, blue = (round(one) for one in colour.tolist())
    return red, green, blue


def as_text(cells: list[list[Cell]], colours: int) -> list[str]:
    """A drawing as rows of letters.

    Args:
        cells: by row and column.
        colours: that the terminal has: 2²⁴, 256, or 0 for none; by escape sequences.
    """
    if not colours:
        return ["".join(_plain(cell) for cell in row) for row in cells]
    code = _code_of_24_bit if colours > 256 else _code_of_256
    rows = []
    for row in cells:
        text, last = "", ""
        for cell in row:
            wanted = f"\x1b[38;{code(cell.colour)};48;{code(cell.ground)}m"
            text += (wanted if wanted != last else "") + cell.letter
            last = wanted
        rows.append(f"{text}\x1b[0m")
    return rows


def _plain(cell: Cell) -> str:
    """A letter for a cell without its colours."""
    red, green, blue = cell.ground
    dark = 1 - (0.299 * red + 0.587 * green + 0.114 * blue) / 255
    shade = next(letter for most, letter in SHADES if dark <= most)
    return shade if cell.letter == " " else cell.letter


def _code_of_24_bit(colour: Colour) -> str:
    return "2;{};{};{}".format(*colour)


@lru_cache(maxsize=4096)
def _code_of_256(colour: Colour) -> str:
    """Of the nearest: the first 16 are as the person set them, and are not used."""
    return f"5;{16 + int(((COLOURS - colour) ** 2).sum(1).argmin())}"


STEPS = (0, 95, 135, 175, 215, 255)

COLOURS = np.array([*product(STEPS, repeat=3), *((8 + 10 * n,) * 3 for n in range(24))])
"""Colours 16 to 255 of a terminal that has 256: red, green and blue."""
