"""Simulated people at the page, in Chromium, by keys alone; and its pictures for docs/study.md.

For each of three tasks ``ask.py`` serves a study, and people with a reward of their own press keys
as Boltzmann humans. They see what the page shows, in its order. Beside their alignment after 20
answers stands that of many simulated humans in one batch, with the same pool, belief and policy:
a mean of so few people should lie within its interval, or the exit status is 1.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)  # and not this folder, whose select.py would hide Python's own

import math
import tempfile
import time
from argparse import Namespace
from collections.abc import Iterator

import torch
from PIL import Image, ImageDraw
from tensordict import TensorDict
from torch import Generator
from tqdm import tqdm

import ask
from benchmarks.common import Row, arguments, report, start
from benchmarks.served import Server
from tests.study.browser import DESKTOP, PHONE, Browser
from torchrl_pref.envs.objectives import alignment
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.problem import solve_tau
from torchrl_pref.questions.base import reordered
from torchrl_pref.questions.responses import model_of
from torchrl_pref.study.log import Log
from torchrl_pref.study.materials import Materials
from torchrl_pref.study.state import possible_answers

BUDGET = 20

UNSEEN = 0.32
"""Seconds in which the page takes no answer to a new question."""


def draw_images(folder: Path, count: int = 80) -> Path:
    """A table of animated images of a ball that rolls; its features are what can be seen."""
    luck = Generator().manual_seed(0)
    rows = ["image,speed,size,redness"]
    for number, (speed, size, red) in enumerate(torch.rand(count, 3, generator=luck).tolist()):
        frames = []
        for moment in range(12):
            frames.append(Image.new("RGB", (240, 150), "#e8ebe4"))
            draw = ImageDraw.Draw(frames[-1])
            draw.rectangle((0, 120, 240, 150), fill="#b9c1ae")
            radius, left = 10 + 35 * size, 10 + moment * (2 + 14 * speed)
            colour = (int(60 + 190 * red), 80, int(200 - 150 * red))
            draw.ellipse((left, 120 - 2 * radius, left + 2 * radius, 120), fill=colour)
        frames[0].save(
            folder / f"{number}.gif", save_all=True, append_images=frames[1:], duration=100, loop=0
        )
        rows.append(f"{number}.gif,{speed},{size},{red}")
    path = folder / "balls.csv"
    path.write_text("\n".join(rows))
    return path


def human_of(materials: Materials) -> SimulatedHuman:
    """Whoever answers as the study expects of the careful: with noise, and without slips."""
    question = materials.question
    tau = solve_tau(materials.settings["tau"], materials.pool)
    return SimulatedHuman(model_of(tau, question, 0.0))


def draw(human: SimulatedHuman, materials: Materials, count: int, seed: int) -> TensorDict:
    """Humans, each with a reward and luck of their own."""
    n_answers = len(possible_answers(materials))
    luck = Generator().manual_seed(seed)
    return human.draw(count, BUDGET, n_answers, materials.pool.n_features, luck)


def batch(materials: Materials, count: int) -> tuple[float, float]:
    """Mean and standard deviation of the alignment of many humans after 20 answers, in one
    batch."""
    human, session = human_of(materials), materials.session(1, count)
    humans = draw(human, materials, count, 2)
    for turn in range(BUDGET):
        turns = torch.full((count,), turn)
        session.tell(human.respond(session.ask().features, humans, turns).tolist())
    found = alignment(session.samples, humans["omega"])
    return float(found.mean()), float(found.std())


def at_page(browser: Browser, link: str, folder: Path, materials: Materials, number: int) -> float:
    """The alignment of one human who presses keys in Chromium until the end."""
    code, human = f"P{number}", human_of(materials)
    one = draw(human, materials, 1, 100 + number)
    log, keys = Log(folder / ask.LOG), possible_answers(materials)
    browser.driver.get(link)
    browser.driver.execute_script("sessionStorage.clear()")
    browser.begin(link, code)
    for turn in range(BUDGET):
        time.sleep(UNSEEN)
        shown = log.events(code)[-1].content
        features = materials.pool.features[shown["query"]].unsqueeze(0)
        answer = int(human.respond(features, one, torch.tensor([turn])))
        meant = reordered(materials.question, tuple(shown["order"])) or range(len(keys))
        browser.press(keys[list(meant).index(answer)]["key"])
        done = f"Question {turn + 2} " if turn + 1 < BUDGET else f"{BUDGET} answers"
        browser.until(lambda done=done: done in browser.text("#count"))
    log.close()
    study = ask.load_study(folder, materials.settings)
    samples = study.people[code].session.samples
    study.close()
    return float(alignment(samples, one["omega"][0]))


def compare(browser: Browser, typed: Namespace, scratch: Path) -> Iterator[Row]:
    """A row for each task."""
    balls = draw_images(scratch)
    tasks = {
        "gridworld": ("task=gridworld",),
        "driver": ("task=driver",),
        "images": ("task=files", f"task.path={balls}", "task.images=image"),
    }
    for name, options in tqdm(tasks.items(), desc="tasks"):
        folder = scratch / name
        server = Server(f"hydra.run.dir={folder}", *options)
        materials = ask.load_materials(folder, ask.load_settings("resume", folder))
        people = [
            at_page(browser, server.link, folder, materials, number)
            for number in tqdm(range(typed.people), desc=name, leave=False)
        ]
        server.close()
        mean, spread = batch(materials, typed.batch)
        half = 1.96 * spread * math.sqrt(1 / typed.people + 1 / typed.batch)
        found = sum(people) / len(people)
        yield {
            "task": name,
            "people in Chromium": typed.people,
            "their alignment": found,
            "batch": f"{mean:.3f} ± {half:.3f}",
            "within": "yes" if abs(found - mean) <= half else "NO",
        }


def pictures(browser: Browser, scratch: Path, folder: Path) -> None:
    """The page as it looks on a desktop and on a phone."""
    folder.mkdir(parents=True, exist_ok=True)
    text = ROOT / "examples" / "instructions.md"
    typed = "study.consent=true", f"study.instructions={text}", "study.title='How should it drive?'"
    server = Server(f"hydra.run.dir={scratch}/study", "task=driver", *typed)
    for name, size in (("desktop", DESKTOP), ("phone", PHONE)):
        browser.size(size)
        browser.driver.get(server.link)
        browser.driver.execute_script("sessionStorage.clear()")
        browser.driver.get(server.link)
        browser.wait_for("#code").send_keys(name)
        save(browser, folder / f"begin-{name}.png")
        browser.find("input[type=checkbox]")[0].click()
        browser.press("\t", "\n")
        browser.wait_for("#prompt")
        for number, key in enumerate("abbaabab", 2):
            browser.answer(key, f"Question {number} ")
        time.sleep(5)
        save(browser, folder / f"question-{name}.png")
        for part in browser.find("details:not([open]) summary"):
            part.click()
        if size == PHONE:
            browser.driver.execute_script("document.getElementById('learned').scrollIntoView()")
        save(browser, folder / f"progress-{name}.png")
        for number, key in enumerate("bbaabbabbab", 10):
            browser.answer(key, f"Question {number} ")
        browser.answer("a", "20 answers")
        browser.driver.execute_script("scrollTo(0, 0)")
        save(browser, folder / f"end-{name}.png")
        browser.click("Take back answer 3")
        browser.wait_for("#prompt")
    server.close()
    for name, size in (("phone", PHONE), ("desktop", DESKTOP)):
        browser.size(size)
        time.sleep(UNSEEN)
        browser.press("a")
        browser.until(lambda: "cannot be reached" in browser.text("#problem"))
        save(browser, folder / f"error-{name}.png")


def save(browser: Browser, path: Path) -> None:
    """What is on the screen, in few colours."""
    time.sleep(0.5)
    browser.driver.save_screenshot(str(path))
    with Image.open(path) as image:
        image.convert("RGB").quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)


def main() -> None:
    """What was typed."""
    parser = arguments(__doc__)
    parser.add_argument("--people", type=int, default=5, help="at the page, a task (default 5)")
    parser.add_argument("--batch", type=int, default=300, help="in the batch (default 300)")
    parser.add_argument("--pictures", type=Path, help="write pictures of the page there instead")
    typed = start(parser)
    browser = Browser()
    try:
        with tempfile.TemporaryDirectory() as scratch:
            if typed.pictures is not None:
                pictures(browser, Path(scratch), typed.pictures)
            else:
                rows = list(compare(browser, typed, Path(scratch)))
                report("Alignment after 20 answers by keys in Chromium", rows, typed.json)
                raise SystemExit(any(row["within"] == "NO" for row in rows))
    finally:
        browser.close()


if __name__ == "__main__":
    main()
