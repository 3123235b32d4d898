"""Scenes as text: what is drawn stands where it is, in as many letters as there is room for."""

from __future__ import annotations

import io
import math
import re

import pytest
import torch
from study_helpers import materials_of

from torchrl_pref.study.terminal.drawing import COLOURS, Cell, Size, as_text, draw, ways_of
from torchrl_pref.study.terminal.options import (
    Room,
    at_one_scale,
    bars_of,
    marks_of,
    options_as_text,
    room_of,
)
from torchrl_pref.study.terminal.player import steps_of
from torchrl_pref.tasks.base import feature_bars
from torchrl_pref.tasks.scene import Disc, Label, Line, Patch, Picture, Scene, Shape

WIDE = Room(140, 50, 0)


def scene_of(*still: Shape, frames: tuple[tuple[Shape, ...], ...] = ((),)) -> Scene:
    """Shapes in a square of 10 by 10."""
    return Scene((0.0, 0.0), (10.0, 10.0), still, frames)


def plain(scene: Scene, columns: int = 20, rows: int = 10, step: int | None = None) -> list[str]:
    return as_text(draw(scene, Size(columns, rows), step), 0)


def walk(*places: tuple[float, float], colour: str = "#d55e00") -> Scene:
    """A disc at one place after the other."""
    return scene_of(frames=tuple((Disc(place, 0.3, colour),) for place in places))


def test_a_line_is_drawn_dot_by_dot() -> None:
    square = Scene((0.0, 0.0), (4.0, 8.0), (Line(((0.5, 7.5), (3.5, 0.5))),), ((),))
    assert plain(square, 2, 2) == ["⢣ ", " ⢣"]
    level = Scene((0.0, 0.0), (4.0, 8.0), (Line(((0.0, 7.9), (4.0, 7.9))),), ((),))
    assert plain(level, 2, 2) == ["⠉⠉", "  "]
    dashed = Scene((0.0, 0.0), (24.0, 4.0), (Line(((0.0, 0.1), (24.0, 0.1)), dashed=True),), ((),))
    assert plain(dashed, 12, 1) == ["⣀⡀ ⣀⡀ ⣀⡀ ⣀⡀ "]


def test_what_moves_leaves_its_way_from_start_to_end() -> None:
    rows = plain(walk((0.5, 9.5), (9.5, 9.5), (9.5, 0.5)))
    assert rows[0][1] == "○"
    assert rows[9][19] == "●"
    assert "●" not in "".join(rows[:9])
    assert all(letter != " " for letter in rows[0][1:])
    assert all(row[19] != " " for row in rows)
    assert all(set(row[:18]) == {" "} for row in rows[1:])
    at_first = plain(walk((0.5, 9.5), (9.5, 9.5), (9.5, 0.5)), step=0)
    assert at_first[0][1] == "●"
    assert "○" not in "".join(at_first)


def test_each_thing_that_moves_has_its_mark() -> None:
    frames = tuple(
        (Disc((step, 2.0), 0.2), Patch(((step, 7.0), (step + 1.0, 7.0), (step, 8.0))))
        for step in (1.0, 8.0)
    )
    rows = "".join(plain(scene_of(frames=frames)))
    assert [rows.count(mark) for mark in "○●□■"] == [1, 1, 1, 1]
    assert marks_of([scene_of(frames=frames)]) == "○ □ start   ● ■ end"
    resting = scene_of(frames=((Disc((1.0, 1.0), 0.2),),) * 3)
    assert ways_of(resting) == []
    assert marks_of([resting]) is None


def test_fills_are_shades_and_labels_are_letters() -> None:
    corners = ((0.0, 5.0), (10.0, 5.0), (10.0, 10.0), (0.0, 10.0))
    dark, pale = scene_of(Patch(corners, "#555555")), scene_of(Patch(corners, "#eeeeee"))
    assert plain(dark) == ["▓" * 20] * 5 + [" " * 20] * 5
    assert plain(pale) == [" " * 20] * 10
    named = plain(scene_of(Label((5.0, 9.8), "goal"), Label((9.9, 0.1), "edge\x1b[2J")))
    assert named[0].strip() == "goal"
    assert named[0].index("goal") == 8
    assert named[9].endswith("edge?[2J")


def test_colours_are_the_nearest_that_the_terminal_has() -> None:
    cells = [[Cell("●", (255, 0, 0), (255, 255, 255)), Cell(" ", (255, 0, 0), (255, 255, 255))]]
    assert as_text(cells, 2**24) == ["\x1b[38;2;255;0;0;48;2;255;255;255m● \x1b[0m"]
    assert as_text(cells, 256) == ["\x1b[38;5;196;48;5;231m● \x1b[0m"]
    assert as_text(cells, 0) == ["● "]
    assert len(COLOURS) == 240
    grey = as_text([[Cell(" ", (9, 9, 9), (231, 238, 227))]], 256)
    assert grey == ["\x1b[38;5;232;48;5;254m \x1b[0m"]


def test_what_no_terminal_can_draw_is_left_out() -> None:
    far = Line(((-1e30, 5.0), (math.inf, 5.0)), "no colour")
    drawn = plain(scene_of(far, Disc((math.nan, 1.0), -1.0), Line(((1.0, 1.0),), dashed=True)))
    assert [len(row) for row in drawn] == [20] * 10
    flat = Scene((1.0, 1.0), (1.0, 1.0), (Line(((1.0, 1.0), (1.0, 1.0))),), ((),))
    assert len(plain(flat)) == 10


@pytest.mark.parametrize("task", ["gridworld", "driver", "lds"])
@pytest.mark.parametrize("columns", [200, 80, 40, 12])
def test_options_are_beside_each_other_as_far_as_there_is_room(task: str, columns: int) -> None:
    materials = materials_of(f"task={task}", "pool.options=4", "strategy=random")
    scenes = at_one_scale([materials.scene(0, option) for option in range(4)])
    rows = options_as_text(scenes, Room(columns, 40, 0))
    assert max(map(len, rows)) <= columns
    heads = [row for row in rows if "┌" in row]
    assert "".join(re.findall("[A-D]", "".join(heads))) == "ABCD"
    if columns == 200:
        assert len(heads) == 1
    if columns == 12:
        assert len(heads) == 4
    coloured = options_as_text(scenes, Room(columns, 40, 256))
    assert [re.sub(r"\x1b\[[\d;]*m", "", row)[0] for row in coloured] == [row[0] for row in rows]


def test_options_are_drawn_at_one_scale() -> None:
    here = walk((1.0, 1.0), (9.0, 9.0))
    wider = Scene((0.0, 0.0), (40.0, 10.0), (), here.frames)
    scenes = at_one_scale([here, wider])
    first, second = (options_as_text([scene], WIDE, letters="") for scene in scenes)
    assert first == second
    assert max(row.find("●") for row in first) < len(first[0]) / 4


def test_features_are_rows_with_bars() -> None:
    names = ("speed", "a\x07 name that is much longer than there is room for")
    scenes = at_one_scale(
        [
            feature_bars(names, torch.tensor(values), torch.tensor(sizes))
            for values, sizes in (([3.0, -2.0], [3.0, -1.5]), ([1.0, 0.0], [0.75, 0.0]))
        ]
    )
    rows = options_as_text(scenes, WIDE)
    assert len(rows) == 4
    assert rows[1].count("▇") == 9 + 2  # three standard deviations, and three quarters of one
    assert "speed: 3 " in rows[1]
    assert "speed: 1 " in rows[1]
    first, second = rows[2].split("   │", 1)
    assert "▇▇▇▇▇│" in first
    assert "▇" not in second
    assert "a? name" in first
    assert "…" in first
    assert ": -2" in first
    assert bars_of(scene_of()) is None
    stacked = options_as_text(scenes, Room(80, 24, 0))
    assert len(stacked) == 8


def test_of_images_the_files_are_named() -> None:
    scenes = [Scene((0.0, 0.0), (1.0, 1.0), (), ((Picture(f"/tmp/{n}.png"),),)) for n in (1, 2)]
    assert options_as_text(scenes, WIDE) == ["  A  /tmp/1.png", "  B  /tmp/2.png"]
    film = Scene((0.0, 0.0), (1.0, 1.0), (), tuple((Picture(f"/tmp/{n}.png"),) for n in range(9)))
    (row,) = options_as_text([film], WIDE, letters="")
    assert row.split() == ["/tmp/0.png,", "…", "9", "files", "…,", "/tmp/8.png"]


def test_a_play_begins_at_the_start_and_finishes_at_the_end() -> None:
    short, long = walk((1.0, 1.0), (2.0, 1.0)), walk(*[(n / 10, 5.0) for n in range(100)])
    assert steps_of([short, long], 4) == [0, 33, 66, 99]
    assert steps_of([short], 4) == [0, 1]
    assert options_as_text([short], WIDE, 2) == options_as_text([short], WIDE, 1)  # it stays there
    assert options_as_text([short], WIDE, 0) != options_as_text([short], WIDE, 1)


def test_room_is_that_of_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    for key, value in {"COLUMNS": "99", "LINES": "33", "TERM": "xterm", "COLORTERM": ""}.items():
        monkeypatch.setenv(key, value)
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert room_of(Terminal()) == Room(99, 33, 256)
    assert room_of(io.StringIO()) == Room(99, 33, 0)
    monkeypatch.setenv("COLORTERM", "truecolor")
    assert room_of(Terminal()) == Room(99, 33, 2**24)
    monkeypatch.setenv("NO_COLOR", "1")
    assert room_of(Terminal()) == Room(99, 33, 0)
