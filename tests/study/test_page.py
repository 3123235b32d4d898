"""The page of a study in a real browser, by what a person does and sees there."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from browser import DESKTOP, PHONE, Browser, needs_chromium, served
from PIL import Image
from selenium.webdriver.common.keys import Keys
from study_helpers import study_of

from torchrl_pref.pool import QueryPool
from torchrl_pref.study.study import Study

pytestmark = needs_chromium


@pytest.fixture(scope="module")
def opened() -> Iterator[Browser]:
    made = Browser()
    yield made
    made.close()


@pytest.fixture
def browser(opened: Browser) -> Iterator[Browser]:
    """As it is when new; it must have nothing to complain of afterwards."""
    opened.size(DESKTOP)
    opened.driver.get("about:blank")
    opened.complaints()
    yield opened
    assert opened.complaints() == []


@pytest.fixture
def study(tmp_path: Path) -> Iterator[Study]:
    made = study_of(tmp_path / "study")
    yield made
    made.close()


@pytest.fixture(autouse=True)
def folder(tmp_path: Path) -> None:
    (tmp_path / "study").mkdir()


def said(study: Study, code: str = "P1") -> list[int | None]:
    return [one.said for one in study.people[code].said]


def test_a_study_by_keys_alone(study: Study, browser: Browser) -> None:
    with served(study) as link:
        browser.begin(link)
        for number, key in enumerate("abba?", 2):
            browser.answer(key, f"Question {number} of at most 6")
        browser.answer("a", "6 answers")
        assert "That was the last question" in browser.text("main")
    assert said(study) == [0, 1, 1, 0, None, 0]
    assert all(one.seconds > 0.3 for one in study.people["P1"].said)


def test_keys_that_mean_nothing_change_nothing(study: Study, browser: Browser) -> None:
    with served(study) as link:
        browser.begin(link)
        browser.answer("a", "Question 2")
        for key in ("b", "c", "1", "x", Keys.ENTER, Keys.ESCAPE):  # b: too soon to be meant
            browser.press(key)
        assert "Question 2" in browser.text("#count")
    assert said(study) == [0]


def test_what_is_learned_is_shown(study: Study, browser: Browser) -> None:
    with served(study) as link:
        browser.begin(link)
        for number in range(2, 5):
            browser.answer("a", f"Question {number}")
        person = study.people["P1"]
        shown = browser.text("#learned").replace("−", "-")
        for name, mean in zip(
            person.session.weights.names, person.session.weights.mean, strict=True
        ):
            assert name in shown
            assert f"{mean:.2f}" in shown
        assert f"{100 * float(person.session.expected_alignment[-1]):.0f} of 100" in shown
        assert f"add {100 * float(person.session.expected_gain):.1f}" in shown
        assert "Your answers (3)" in shown


def test_an_earlier_answer_is_taken_back_and_given_again(study: Study, browser: Browser) -> None:
    with served(study) as link:
        browser.begin(link)
        for number in range(2, 5):
            browser.answer("a", f"Question {number}")
        first = study.people["P1"].said[0].shown
        browser.click("Take back answer 1")
        browser.until(lambda: "You took back your answer" in browser.text("main"))
        shown = study.people["P1"].shown
        assert shown is not None
        assert (shown.query, shown.order) == (first.query, first.order)
        browser.answer("b", "Question 4")
        browser.press("u")
        browser.until(lambda: "Question 3" in browser.text("#count"))
    assert said(study) == [0, 0]


def test_stopping_and_going_on(study: Study, browser: Browser) -> None:
    with served(study) as link:
        browser.begin(link)
        browser.answer("a", "Question 2")
        browser.click("Stop here")
        browser.until(lambda: "You stopped here" in browser.text("main"))
        browser.driver.refresh()
        browser.until(lambda: "You stopped here" in browser.text("main"))
        browser.click("Go on")
        browser.until(lambda: "Question 2" in browser.text("#count"))


def test_an_answer_outlives_a_server_that_dies_and_a_reload(
    tmp_path: Path, browser: Browser
) -> None:
    study = study_of(tmp_path / "study")
    with served(study) as link:
        browser.begin(link)
        browser.answer("a", "Question 2")
    port = int(link.rsplit(":", 1)[1].strip("/"))
    study.close()
    threading.Event().wait(0.4)
    browser.press("b")
    browser.until(lambda: "cannot be reached" in browser.text("#problem"))
    assert browser.violations() == []
    study = study_of(tmp_path / "study")  # rebuilt from its log
    with served(study, port):
        browser.driver.refresh()
        browser.until(lambda: "Question 3" in browser.text("#count"))
        assert not browser.find("#problem")[0].is_displayed()
        assert said(study) == [0, 1]
    study.close()
    assert [one for one in browser.complaints() if "ERR_CONNECTION_REFUSED" not in one] == []


def test_two_tabs_of_one_person(study: Study, browser: Browser) -> None:
    with served(study) as link:
        browser.begin(link)
        one = browser.driver.current_window_handle
        browser.driver.switch_to.new_window("tab")
        other = browser.driver.current_window_handle
        browser.begin(link)
        browser.answer("a", "Question 2")
        browser.driver.switch_to.window(one)  # it looks again, and sees that
        browser.until(lambda: "Question 2" in browser.text("#count"))
        key = study.people["P1"].shown
        assert key is not None
        study.people["P1"].answer(key.key, 1, 1.0, 0)  # and now it cannot know
        threading.Event().wait(0.4)
        browser.press("a")
        browser.until(lambda: "answered or changed elsewhere" in browser.text("#problem"))
        assert "Question 3" in browser.text("#count")
        browser.driver.switch_to.window(other)
        browser.driver.close()
        browser.driver.switch_to.window(one)
    assert said(study) == [0, 1]
    assert all("409" in one for one in browser.complaints())


@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_axe_finds_nothing_wrong(tmp_path: Path, browser: Browser, size: tuple[int, int]) -> None:
    text = tmp_path / "text.md"
    text.write_text("# About this\n\nYou see *two* ways.\n\n- one\n- two\n")
    typed = f"study.instructions={text}", "study.consent=true", "study.attention=1"
    study = study_of(tmp_path / "study", *typed, "question=weak", "setup.budget=4")
    browser.size(size)
    with served(study) as link:
        browser.driver.get(link)
        browser.wait_for("#code").send_keys("not a code", Keys.ENTER)
        assert browser.violations() == []
        assert "About this" in browser.text("main")
        browser.wait_for("#code").clear()
        browser.wait_for("#code").send_keys("P1")
        browser.find("input[type=checkbox]")[0].click()
        browser.press(Keys.ENTER)
        browser.wait_for("#prompt")
        for part in browser.find("details:not([open]) summary"):
            part.click()
        for number, key in enumerate("a=?a", 2):
            assert browser.violations() == []
            assert (
                browser.driver.execute_script("return document.documentElement.scrollWidth")
                <= size[0]
            )
            browser.answer(key, f"Question {number}")
        browser.answer("a", "5 answers")
        assert browser.violations() == []
    study.close()


def test_the_focus_goes_through_the_page_in_the_order_of_reading(
    study: Study, browser: Browser
) -> None:
    with served(study) as link:
        browser.begin(link)
        names = []
        for _ in range(8):
            browser.press(Keys.TAB)
            names.append(browser.driver.switch_to.active_element.accessible_name)
        wanted = ["Choose A", "Choose B", "P", "Replay", "Speed", "Moment", "Cannot say", "Stop"]
        for name, start in zip(names, wanted, strict=True):
            assert name.startswith(start), names
        browser.press(Keys.TAB)
        browser.press(Keys.ENTER)  # the first part of the panel folds
        assert len(browser.find("details[open]")) == 2


def test_nothing_moves_where_people_want_no_motion(study: Study, browser: Browser) -> None:
    browser.driver.execute_cdp_cmd(
        "Emulation.setEmulatedMedia",
        {"features": [{"name": "prefers-reduced-motion", "value": "reduce"}]},
    )
    try:
        with served(study) as link:
            browser.begin(link)
            slider = browser.wait_for("main input[type=range]")
            assert slider.get_attribute("value") == slider.get_attribute("max")
            slider.send_keys(Keys.HOME)
            assert slider.get_attribute("value") == "0"
            seen = set()
            for _ in range(4):
                seen.add(browser.driver.execute_script(PIXELS))
                slider.send_keys(Keys.ARROW_RIGHT)
            assert len(seen) > 1
            browser.press("r")  # whoever asks for it sees it
            browser.until(lambda: int(slider.get_attribute("value") or 0) > 0)
    finally:
        browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


PIXELS = "return document.querySelector('main canvas').toDataURL()"


def test_it_plays_pauses_and_plays_again(study: Study, browser: Browser) -> None:
    with served(study) as link:
        browser.begin(link)
        slider = browser.wait_for("main input[type=range]")
        browser.until(lambda: 0 < int(slider.get_attribute("value") or 0) < 19)
        browser.press(" ")
        paused = slider.get_attribute("value")
        threading.Event().wait(0.5)
        assert slider.get_attribute("value") == paused
        browser.press("s", "r")
        browser.until(lambda: slider.get_attribute("value") == "19")
        browser.answer("a", "Question 2")
    assert [one.replays for one in study.people["P1"].said] == [1]


@pytest.mark.parametrize(
    ("typed", "keys", "answers"),
    [
        (("question=ranking", "pool.options=3"), ["b", "c"], [3]),
        (("question=best_worst", "pool.options=3"), ["c", "a"], [4]),
        (("question=approve", "pool.options=1"), ["n"], [0]),
        (("question=choice", "pool.options=4"), ["d"], [3]),
    ],
)
def test_every_kind_of_question(
    tmp_path: Path, browser: Browser, typed: tuple[str, ...], keys: list[str], answers: list[int]
) -> None:
    study = study_of(tmp_path / "study", *typed)
    with served(study) as link:
        browser.begin(link)
        for key in keys[:-1]:
            threading.Event().wait(0.4)
            browser.press(key, key)  # chosen, and taken back
            assert "So far" not in browser.text("main")
            browser.press(key)
            assert "So far" in browser.text("main")
        browser.answer(keys[-1], "Question 2")
    assert said(study) == answers
    study.close()


def test_names_are_shown_as_text(tmp_path: Path, browser: Browser) -> None:
    name = "<img src=x onerror=alert(1)>"
    pool = QueryPool(torch.rand(20, 2, 2), feature_names=(name, "<script>alert(2)</script>"))
    pool.save(tmp_path / "pool.pt")
    typed = f"pool.file={tmp_path / 'pool.pt'}", "study.title='<b>bold</b>'"
    study = study_of(tmp_path / "study", *typed)
    with served(study) as link:
        browser.begin(link)
        assert name in browser.text("#learned")
        assert "<b>bold</b>" in browser.text("h1")
        assert not browser.find("img, h1 b, body script")
    study.close()


@pytest.mark.parametrize("kind", ["png", "gif"])
def test_images_and_nothing_from_elsewhere(tmp_path: Path, browser: Browser, kind: str) -> None:
    rows = ["image,size,age"]
    for number in range(12):
        frames = [Image.new("RGB", (40, 30), (20 * number, 90, 40 * at)) for at in range(4)]
        name = f"{number}.{kind}"
        more = {"save_all": True, "append_images": frames[1:]} if kind == "gif" else {}
        frames[0].save(tmp_path / name, **more)
        rows.append(f"{name},{number},{number % 3}")
    (tmp_path / "t.csv").write_text("\n".join(rows))
    typed = "task=files", f"task.path={tmp_path / 't.csv'}", "task.images=image", "pool.size=30"
    study = study_of(tmp_path / "study", *typed)
    with served(study) as link:
        browser.driver.get_log("performance")
        browser.begin(link)
        browser.until(lambda: browser.driver.execute_script(DRAWN))
        sliders = browser.find("main input[type=range]")
        assert [one.get_attribute("max") for one in sliders] == (["3"] if kind == "gif" else [])
        browser.answer("a", "Question 2")
        asked = [
            message["params"]["request"]["url"]
            for entry in browser.driver.get_log("performance")
            if (message := json.loads(entry["message"])["message"])["method"]
            == "Network.requestWillBeSent"
        ]
    study.close()
    assert any("/api/picture/" in url for url in asked)
    assert all(url.startswith((link, "data:", "about:")) for url in asked)


DRAWN = """
const canvas = document.querySelector("main canvas");
// A copy: the browser complains of a canvas that is read from again and again.
const copy = document.createElement("canvas");
[copy.width, copy.height] = [canvas.width, canvas.height];
const seen = copy.getContext("2d", {willReadFrequently: true});
seen.drawImage(canvas, 0, 0);
const pixels = seen.getImageData(0, 0, copy.width, copy.height).data;
return pixels.some((value) => value > 0);
"""


def test_somebody_else_begins_and_nothing_of_the_first_is_touched(
    study: Study, browser: Browser
) -> None:
    with served(study) as link:
        browser.begin(link)
        browser.answer("a", "Question 2")
        browser.click("Somebody else")
        browser.wait_for("#code")
        browser.press(Keys.TAB)
        browser.press("u", "a", "r", " ")  # which were keys of the first person
        browser.begin(link, "P2")
        browser.answer("b", "Question 2")
    assert said(study) == [0]
    assert said(study, "P2") == [1]


def test_an_answer_is_kept_until_the_link_has_its_key(tmp_path: Path, browser: Browser) -> None:
    study = study_of(tmp_path / "study")
    with served(study) as link:
        browser.begin(link)
        threading.Event().wait(0.4)
        key = study.people["P1"].shown
        assert key is not None
        browser.driver.execute_script(WITHOUT_KEY)
        browser.press("b")
        browser.until(lambda: "lacks the key" in browser.text("#problem"))
        browser.driver.refresh()
        browser.until(lambda: "Question 2" in browser.text("#count"))
    assert said(study) == [1]
    study.close()


WITHOUT_KEY = """
window.fetch = async () => new Response(
  JSON.stringify({ error: "This link lacks the key of the study.", state: null }), { status: 401 });
"""
