"""Scenes as files, and the command that makes a sheet of them."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from PIL import ExifTags, Image, ImageChops, ImageDraw, ImageOps
from recordings import DATASET, write_csv, write_minari

from torchrl_pref.errors import InputError
from torchrl_pref.pool import QueryPool
from torchrl_pref.tasks import TASKS, drawing
from torchrl_pref.tasks.__main__ import main
from torchrl_pref.tasks.base import make_pool
from torchrl_pref.tasks.drawing import save_animation, save_picture
from torchrl_pref.tasks.gridworld import WALKER, GridworldTask
from torchrl_pref.tasks.images import Images
from torchrl_pref.tasks.scene import Disc, Label, Line, Patch, Picture, Scene
from torchrl_pref.tasks.sheet import columns_of, contact_sheet, sheet, widened

RED, GREEN, BLUE = "#ff0000", "#00ff00", "#0000ff"


def square(left: float, low: float, right: float, high: float, colour: str) -> Patch:
    return Patch(((left, low), (right, low), (right, high), (left, high)), colour)


def moving(count: int = 5, width: float = 2.0) -> Scene:
    """A red ground, and a blue disc that goes from the left to the right."""
    ground = square(-9, -9, 9, 9, RED)
    way = [(0.2 + (width - 0.4) * step / max(1, count - 1), 0.5) for step in range(count)]
    return Scene((0, 0), (width, 1), (ground,), tuple((Disc(at, 0.15, BLUE),) for at in way))


def colour_at(image: Image.Image, x: float, y: float) -> tuple[int, ...]:
    """At shares of the width from the left and of the height from the top, as plain colours."""
    place = (round(x * (image.width - 1)), round(y * (image.height - 1)))
    pixel = image.convert("RGB").getpixel(place)
    assert isinstance(pixel, tuple)
    return tuple(round(value / 255) for value in pixel)


def test_a_picture_shows_the_last_frame(tmp_path: Path) -> None:
    save_picture(moving(), tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as image:
        assert colour_at(image, 0.1, 0.5) == (1, 0, 0)
        assert colour_at(image, 0.88, 0.5) == (0, 0, 1)
        assert colour_at(image, 0.0, 0.0) == (1, 1, 1)


def test_units_are_equal_whatever_the_shape(tmp_path: Path) -> None:
    for name, low, high in (("wide", (-4, -1), (4, 1)), ("tall", (-1, -4), (1, 4))):
        scene = Scene(low, high, (square(-0.5, -0.5, 0.5, 0.5, BLUE),), ((),))
        save_picture(scene, tmp_path / f"{name}.png")
        with Image.open(tmp_path / f"{name}.png") as image:
            red = image.convert("RGB").getchannel("R").point(lambda value: 255 * (value < 127))
            left, top, right, bottom = red.getbbox() or (0, 0, 0, 0)
            assert abs((right - left) - (bottom - top)) <= 2


def test_every_shape_is_drawn_in_its_order(tmp_path: Path) -> None:
    Image.new("RGB", (4, 4), GREEN).save(tmp_path / "green.gif")
    for shape, colour in (
        (square(0, 0, 2, 1, BLUE), (0, 0, 1)),
        (Line(((0, 0.5), (2, 0.5)), BLUE, 20.0), (0, 0, 1)),
        (Disc((1, 0.5), 0.3, BLUE), (0, 0, 1)),
        (Picture(str(tmp_path / "green.gif")), (0, 1, 0)),
    ):
        ground = square(0, 0, 2, 1, RED)
        for name, still, frame, expected in (
            ("above", (ground,), (shape,), colour),
            ("below", (shape, ground), (), (1, 0, 0)),
        ):
            save_picture(Scene((0, 0), (2, 1), still, (frame,)), tmp_path / f"{name}.png")
            with Image.open(tmp_path / f"{name}.png") as image:
                assert colour_at(image, 0.5, 0.5) == expected


def with_disc(path: Path, size: tuple[int, int], colours: Sequence[str]) -> Picture:
    """An image file with a blue disc, 40 pixels wide, on a ground of a colour for each frame."""
    frames = []
    for colour in colours:
        frames.append(Image.new("RGB", size, colour))
        x, y = size[0] // 2, size[1] // 2
        ImageDraw.Draw(frames[-1]).ellipse((x - 20, y - 20, x + 20, y + 20), BLUE)
    frames[0].save(path, save_all=len(frames) > 1, append_images=frames[1:], duration=50)
    return Picture(str(path))


def of_image(picture: Picture) -> Scene:
    """As the files' task has it."""
    return Scene((0.0, 0.0), (1.0, 1.0), (), ((picture,),))


def blue_size(image: Image.Image) -> tuple[int, int]:
    """Width and height of what is blue."""
    red, _, blue = image.convert("RGB").split()
    shown = ImageChops.subtract(blue, red).point(lambda value: 255 * (value > 127))
    left, top, right, bottom = shown.getbbox() or (0, 0, 0, 0)
    return right - left, bottom - top


@pytest.mark.parametrize("size", [(320, 80), (80, 320), (50, 50)])
def test_images_keep_their_shape(size: tuple[int, int], tmp_path: Path) -> None:
    wide = of_image(with_disc(tmp_path / "wide.png", (320, 80), ["white"]))
    scene = of_image(with_disc(tmp_path / "disc.png", size, ["white"]))
    ground = Scene((0, 0), (3, 1), (*scene.frames[0], Label((0, 0), "A")), ((),))
    for scenes in (scene, [scene, scene], [ground]):
        save_picture(scenes, tmp_path / "a.png")
        save_animation(scenes, tmp_path / "a.gif")
        for name in ("a.png", "a.gif"):
            with Image.open(tmp_path / name) as image:
                if not isinstance(scenes, Scene):
                    image = image.crop((0, 0, image.width // len(scenes), image.height))
                across, up = blue_size(image)
                assert across > 15
                assert abs(across - up) <= 2
    figure = sheet([[scene], [wide]], [[[0.0]], [[0.0]]], ["speed"])
    places = [axes.images[0] for axes in figure.axes if axes.images]
    for (across, up), drawn in zip((size, (320, 80)), places, strict=True):
        box = drawn.get_window_extent()
        assert abs(box.width / box.height / (across / up) - 1) < 1e-6
        assert drawn.axes is not None
        assert drawn.axes.bbox.padded(1e-6).get_points().tolist()[0] <= box.get_points().tolist()[0]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_photographs_stand_upright(orientation: int, tmp_path: Path) -> None:
    """A camera that was turned says so in the file (EXIF), and a browser turns the image back."""
    photograph = Image.new("RGB", (320, 80), "white")
    photograph.paste("blue", (0, 0, 160, 40))
    tags = Image.Exif()
    tags[ExifTags.Base.Orientation] = orientation
    photograph.save(tmp_path / "a.jpg", exif=tags, quality=95)
    expected = ImageOps.exif_transpose(Image.open(tmp_path / "a.jpg")).convert("RGB")
    picture = Picture(str(tmp_path / "a.jpg"))
    assert Images().aspect(picture) == expected.height / expected.width
    seen = Images().at(picture, 0).convert("RGB")
    assert seen.size == expected.size
    assert not ImageChops.difference(seen, expected).getbbox()


def test_tags_of_a_photograph_may_be_damaged(tmp_path: Path) -> None:
    tags = Image.Exif()
    tags[ExifTags.Base.Orientation] = 6
    Image.new("RGB", (40, 10), "blue").save(tmp_path / "a.jpg", exif=tags)
    data = (tmp_path / "a.jpg").read_bytes()
    start = data.index(b"Exif") + 6
    end = start + 26  # a header of 8 bytes, and one tag
    picture = Picture(str(tmp_path / "b.jpg"))
    for place in range(start, end):
        for value in (0, 1, 7, 127, 255):
            (tmp_path / "b.jpg").write_bytes(data[:place] + bytes([value]) + data[place + 1 :])
            assert Images().aspect(picture) in (4.0, 0.25)
            assert sorted(Images().at(picture, 0).size) == [10, 40]


def test_the_shape_of_a_panel_is_that_of_its_images(tmp_path: Path) -> None:
    wide = of_image(with_disc(tmp_path / "wide.png", (320, 80), ["white"]))
    save_picture(wide, tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as image:
        assert 3.5 < image.width / image.height < 4
        assert blue_size(image)[0] > image.width / 10  # as large as there is room


def test_clips_move(tmp_path: Path) -> None:
    """A GIF of three frames beside one of two, which stays at its end; a sheet shows the last."""
    clip = of_image(with_disc(tmp_path / "clip.gif", (80, 80), [RED, GREEN, "white"]))
    short = of_image(with_disc(tmp_path / "short.gif", (80, 80), [GREEN, RED]))
    save_animation([clip, short], tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as image:
        assert image.n_frames == 3
        for moment, grounds in enumerate(
            [((1, 0, 0), (0, 1, 0)), ((0, 1, 0), (1, 0, 0)), ((1, 1, 1), (1, 0, 0))]
        ):
            image.seek(moment)
            assert (colour_at(image, 0.1, 0.8), colour_at(image, 0.9, 0.8)) == grounds
    save_picture(short, tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as image:
        assert colour_at(image, 0.1, 0.8) == (1, 0, 0)


def test_svg_holds_the_words_and_is_the_same_again(tmp_path: Path) -> None:
    ground = square(-1, -1, 3, 3, RED)  # which is cut off, by a mask with a name
    scene = Scene((0, 0), (2, 1), (ground, Label((1, 0.5), "Zebra")), ((),))
    save_picture(scene, tmp_path / "a.svg")
    text = (tmp_path / "a.svg").read_text()
    assert text.startswith("<?xml")
    assert "Zebra" in text
    assert "<dc:date>" not in text
    save_picture(scene, tmp_path / "b.svg")
    assert (tmp_path / "b.svg").read_text() == text


def test_an_animation_moves_and_begins_again(tmp_path: Path) -> None:
    save_animation([moving(), moving(3)], tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as image:
        assert image.n_frames == 5
        assert image.info["loop"] == 0
        assert colour_at(image, 0.08, 0.55) == (0, 0, 1)
        assert colour_at(image, 0.45, 0.55) == (1, 0, 0)
        image.seek(4)
        assert colour_at(image, 0.08, 0.55) == (1, 0, 0)
        assert colour_at(image, 0.45, 0.55) == (0, 0, 1)
        assert colour_at(image, 0.94, 0.55) == (0, 0, 1)  # the shorter one waits at its end


@pytest.mark.parametrize("frames", [1, 2, 60, 61, 200])
def test_an_animation_has_at_most_60_frames(tmp_path: Path, frames: int) -> None:
    thin = moving(frames, width=8.0)
    save_animation(thin, tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as image:
        assert image.n_frames == min(frames, 60)


def test_files_are_whole_or_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_picture(moving(), tmp_path / "a.png")
    before = (tmp_path / "a.png").read_bytes()

    def fails(*_: object) -> None:
        raise RuntimeError("in the middle of it")

    monkeypatch.setattr(drawing, "draw", fails)
    with pytest.raises(RuntimeError):
        save_picture(moving(), tmp_path / "a.png")
    with pytest.raises(RuntimeError):
        save_animation(moving(), tmp_path / "a.gif")
    assert os.listdir(tmp_path) == ["a.png"]
    assert (tmp_path / "a.png").read_bytes() == before


def test_what_cannot_be_drawn_is_refused(tmp_path: Path) -> None:
    (tmp_path / "bad.png").write_bytes(b"\x89PNG\r\n\x1a\n and no more")
    bad = Scene((0, 0), (1, 1), (Picture(str(tmp_path / "bad.png")),), ((),))
    gone = Scene((0, 0), (1, 1), (Picture(str(tmp_path / "gone.png")),), ((),))
    for scenes, name, message in (
        (moving(), "a.bmp", "expected a name that ends in .png or .svg"),
        (moving(), "no/folder/a.png", "cannot be written"),
        ([], "a.png", "0 trajectories: expected 1 to 8"),
        ([moving()] * 9, "a.png", "9 trajectories"),
        (bad, "a.png", "bad.png: cannot be shown"),
        (gone, "a.png", "gone.png: cannot be shown"),
    ):
        with pytest.raises(InputError, match=re.escape(message)) as caught:
            save_picture(scenes, tmp_path / name)
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match=r"ends in \.gif"):
        save_animation(moving(), tmp_path / "a.png")
    assert os.listdir(tmp_path) == ["bad.png"]


@pytest.mark.parametrize("name", ["gridworld", "driver", "lds"])
def test_a_sheet_shows_every_query(name: str, tmp_path: Path) -> None:
    task = TASKS[name]()
    contact_sheet(task, make_pool(task, 3, 2, 0), tmp_path / "sheet.svg")
    text = (tmp_path / "sheet.svg").read_text()
    for word in ("A", "B", "1", "2", "3", *task.feature_names):
        shown = len(re.findall(rf"<!-- {re.escape(word)} -->|>{re.escape(word)}</text>", text))
        assert shown >= (1 if word.isdigit() else 3), word


def test_a_sheet_shows_where_trajectories_end(tmp_path: Path) -> None:
    task = GridworldTask(3, 4)
    contact_sheet(task, make_pool(task, 5, 3, 0), tmp_path / "sheet.svg")
    assert (tmp_path / "sheet.svg").read_text().count(f"fill: {WALKER}") == 15


def test_a_sheet_refuses_what_it_cannot_show(tmp_path: Path) -> None:
    task = GridworldTask()
    pool = make_pool(task, 61, 2, 0)
    with pytest.raises(InputError, match="61 queries of 2 options: expected at most 60"):
        contact_sheet(task, pool, tmp_path / "a.png")
    with pytest.raises(InputError, match="2 queries of 9 options"):
        contact_sheet(task, make_pool(task, 2, 9, 0), tmp_path / "a.png")
    with pytest.raises(InputError, match="without trajectories"):
        contact_sheet(task, QueryPool(torch.rand(2, 2, 4)), tmp_path / "a.png")


def test_a_grid_is_filled() -> None:
    assert columns_of(6, 1.0) == 3
    assert columns_of(1, 3.0) == 1
    assert columns_of(4, 0.5) in (2, 4)
    assert widened(((0, 0), (1, 1)), 2.0) == ((0, -0.5), (1, 1.5))
    assert widened(((0, 0), (1, 1)), 0.5) == ((-0.5, 0), (1.5, 1))


def test_the_command_draws_any_task(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "sheet.png"
    main(["gridworld", "size=3", "length=4", "--queries", "2", "--animate", "--out", str(path)])
    assert capsys.readouterr().out.split() == [str(path), str(tmp_path / "sheet.gif")]
    with Image.open(tmp_path / "sheet.gif") as image:
        assert image.n_frames == 4
    before = path.read_bytes()
    main(["gridworld", "size=3", "length=4", "--queries", "2", "--out", str(path)])
    assert path.read_bytes() == before


TYPED = {
    "gridworld": ["size=3"],
    "driver": [],
    "lds": ["released_inputs=true"],
    "gymnasium": ["id=Pendulum-v1", "length=9", "features=recordings:reach"],
    "torchrl": ["make=recordings:grid", "length=9", "features=recordings:reach"],
    "gaussian": ["dimension=3"],
    "files": ["path=x.csv"],
    "minari": [f"id={DATASET}"],
    "my_task:Table": ["steps=9"],
}
"""What is typed for each task; code in it is of the folder of the tests."""


@pytest.mark.parametrize("name", [*TASKS, "my_task:Table"])
def test_the_command_draws_every_task(
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    if name == "files":
        write_csv(tmp_path / "x.csv", 20)
    if name == "minari":
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
        write_minari(tmp_path)
    main([name, *TYPED[name], "--queries", "2"])
    path = f"{name.removeprefix('my_task:')}.png"
    assert capsys.readouterr().out == f"{path}\n"
    with Image.open(path) as image:
        assert image.width > 300
        assert len(image.convert("RGB").getcolors(2**20) or ()) > 9  # something is drawn


def test_code_is_looked_for_in_the_present_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    Path("brought.py").write_text("from recordings import grid as world, reach as ends\n")
    main(["torchrl", "make=brought:world", "features=brought:ends", "length=5", "--queries", "1"])
    assert Path("torchrl.png").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["grid"], "grid: no task; expected one of gridworld, driver"),
        (["my_task:Chair"], "my_task.py has no Chair"),
        (["no_such_module:Table"], "error: no_such_module:Table: no module no_such_module"),
        (["my_task:Table", "size=3"], "size=3: no setting of my_task:Table; expected steps=…"),
        (["my_task:Table", "steps=[]"], "error: my_task:Table: its first trajectories fail (Type"),
        (["recordings:grid"], "recordings:grid: makes a Gridworld; expected a Task"),
        (["torchrl"], "error: make=null: expected a function of yours"),
        (["torchrl"], "type make=<module>:"),
        (["torchrl", "make=3"], "error: make=3: expected <module>:<name>"),
        (["gymnasium", "id=Pendulum-v1"], "type features=<module>:"),
        (["gymnasium", "features=recordings:none"], "recordings.py has no none"),
        (["files"], "type path="),
        (["gridworld", "width=3"], "width=3: no setting of gridworld; expected size=…, length=…"),
        (["driver", "size=3"], "no setting of driver; expected none"),
        (["gridworld", "size"], "no setting of gridworld"),
        (["gridworld", "size=1"], "size=1: expected a whole number of at least 2"),
        (["lds", "released_inputs=maybe"], "expected true or false"),
        (["driver", "--queries", "0"], "--queries=0: expected"),
        (["driver", "--queries", "99"], "99 queries"),
        (["driver", "--seed", "-1"], "--seed=-1: expected"),
        (["driver", "--out", "x.bmp"], "ends in .png or .svg"),
    ],
)
def test_what_is_typed_wrong_is_said_in_one_line(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    errors = capsys.readouterr().err
    assert message in errors
    assert errors.count("\n") == 1


def test_help_tells_the_tasks_and_their_settings(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    told = capsys.readouterr().out
    for word in (*TASKS, "size=8", "released_inputs=false", "--animate"):
        assert word in told
