"""``setup.batch``: what may be typed, and what files of before it mean."""

from __future__ import annotations

from typing import Any

import pytest
from config.test_settings import composed
from helpers import settings_of

from torchrl_pref.checkpoints.migrations import migrate
from torchrl_pref.config import settings, together
from torchrl_pref.errors import InputError


def test_batches_may_be_evaluated() -> None:
    typed = composed("evaluate", "setup=query", "setup.batch=10")
    assert settings.check_evaluate_settings(typed)["setup"]["batch"] == 10
    assert composed("evaluate", "setup=query")["setup"]["batch"] == 1


@pytest.mark.parametrize(
    ("script", "typed", "message"),
    [
        ("evaluate", ["setup.batch=0"], "setup.batch=0: expected a whole number of at least 1"),
        ("evaluate", ["setup.batch=7"], "setup.budget=20 with setup.batch=7: expected a budget of"),
        ("evaluate", ["setup.batch=5", "policy=pretrained"], "policy=pretrained chooses one query"),
        ("train", ["setup.batch=5"], "a policy that is learned chooses one query at a time"),
        ("train", ["setup.batch=7"], "compare batches by evaluate.py setup=query"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(script: str, typed: list[str], message: str) -> None:
    check: dict[str, Any] = {
        "train": settings.check_train_settings,
        "evaluate": settings.check_evaluate_settings,
    }
    with pytest.raises(InputError) as error:
        check[script](composed(script, "setup=query", *typed))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_the_extra_is_named_before_anything_is_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(together, "find_spec", lambda name: None)
    settings.check_evaluate_settings(composed("evaluate", "setup=query"))
    with pytest.raises(InputError, match=r"setup\.batch=2: kmedoids is not .*'\.\[batch\]', or"):
        settings.check_evaluate_settings(composed("evaluate", "setup=query", "setup.batch=2"))


def test_files_of_before_asked_one_at_a_time() -> None:
    for setup, expected in (("query", 1), ("feed", None)):
        old = settings_of(setup)
        old["setup"].pop("batch")
        migrate(old)
        migrate(old)
        assert old["setup"].get("batch") == expected
    migrate(old := {"setup": "spoiled"})
    assert old["setup"] == "spoiled"
