"""Studies in a folder of a test, and people who answer in them."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from PIL import Image
from starlette.testclient import TestClient

from torchrl_pref.config.study import check_ask_settings
from torchrl_pref.study.materials import Materials, draw_pool, make_materials
from torchrl_pref.study.participant import Participant
from torchrl_pref.study.study import Study
from torchrl_pref.study.web import make_app

CONF = Path(__file__).parents[2] / "conf"

ADDRESS = "127.0.0.1:8000"

SMALL = ("pool.size=60", "setup.budget=6", "strategy=alignment_gain")


def settings_of(*typed: str) -> dict[str, Any]:
    """The settings of ``python ask.py <typed>``."""
    settings = deepcopy(_composed(*typed))
    return check_ask_settings({str(key): value for key, value in settings.items()})


@cache
def _composed(*typed: str) -> dict[Any, Any]:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        settings = OmegaConf.to_container(compose("ask", overrides=[*SMALL, *typed]))
    assert isinstance(settings, dict)
    return settings


def materials_of(*typed: str) -> Materials:
    settings = settings_of(*typed)
    return make_materials(settings, draw_pool(settings))


def study_of(folder: Path, *typed: str) -> Study:
    """A study of a few questions, or the one that is there."""
    return Study(folder, materials_of(*typed))


def write_table(folder: Path) -> None:
    """Trajectories of one's own: three features, and an image of each."""
    rows = ["speed,comfort,energy,picture"]
    for number in range(30):
        Image.new("RGB", (4, 4), (8 * number, 0, 0)).save(folder / f"{number}.png")
        rows.append(f"{number % 7},{number % 5},{number % 3},{number}.png")
    (folder / "runs.csv").write_text("\n".join(rows))


def client_of(study: Study, token: str | None = None) -> TestClient:
    """Who talks to the server of a study, as from its page."""
    app = make_app(study, () if token else ("127.0.0.1", "localhost"), token)
    return TestClient(app, f"http://{ADDRESS}", raise_server_exceptions=False)


def answer_all(person: Participant, choose: Callable[[Participant], int | None]) -> None:
    """Answer until there is no question left."""
    person.go_to_next()
    while person.shown is not None:
        person.answer(person.shown.key, choose(person), 1.5, 0)


def careful(omega: torch.Tensor) -> Callable[[Participant], int]:
    """Somebody who picks what is best of what is shown."""

    def choose(person: Participant) -> int:
        assert person.shown is not None
        options = person.session.pool.features[person.shown.query][list(person.shown.order)]
        return int((options @ omega).argmax())

    return choose
