"""What it costs that a belief takes the human for another: held against a belief that is right."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import settings_of, trainer_of

from torchrl_pref.build import make_pools, make_query_env, make_task
from torchrl_pref.evaluation.comparison import evaluate_misjudged
from torchrl_pref.evaluation.records import CSV, Records, read_records, write_records
from torchrl_pref.evaluation.run import draw_humans
from torchrl_pref.evaluation.tables import misjudging, tables
from torchrl_pref.evaluation.views import alignment, measured
from torchrl_pref.training.start import make_checkpoint

SIMULATED = {"name": "simulated", "spread": 1, "tau": None, "lapse": 0.0}
OTHERS: dict[str, dict[str, Any]] = {
    "tau": {"human": {**SIMULATED, "tau": 1.0}},
    "lapse": {"human": {**SIMULATED, "lapse": 0.2}},
    "no lapse": {"belief.lapse": 0.2},
    "spread": {"human": {**SIMULATED, "spread": 4.0}},
    "never errs": {"human": {**SIMULATED, "tau": "optimal"}},
    "skipping": {"human": {"name": "skipping", "threshold": 0.0, "tau": None, "lapse": 0.0}},
    "drifting": {"human": {"name": "drifting", "drift": 0.1, "tau": 1.0, "lapse": 0.0}},
}
TOLD = ("tau", "lapse", "no lapse")
"""Of these the belief can be told the truth."""


def settings_for(which: str | None) -> dict[str, Any]:
    settings = settings_of("query")
    settings["setup"]["budget"] = 4
    settings["evaluation"] |= {"humans": 6, "metrics": ["calibration"]}
    for key, value in ({} if which is None else OTHERS[which]).items():
        section, _, name = key.partition(".")
        settings[section] = {**settings[section], name: value} if name else value
    return settings


def evaluated(settings: dict[str, Any], tau: Any = 4.0) -> Records:
    task = make_task(*make_pools(settings), tau, settings)
    records = Records()
    for found in evaluate_misjudged(settings, task, {}):
        records.add(found)
    return records


@pytest.mark.parametrize("which", OTHERS)
def test_the_belief_is_right_in_the_reference_alone(which: str) -> None:
    settings = settings_for(which)
    task = make_task(*make_pools(settings), 4.0, settings)
    right = task.judging_rightly()
    assert task.misjudges
    assert not right.misjudges
    assert "assumed" in task.title
    assert "assumed" not in right.title
    if which in TOLD:  # the same human
        assert right.human == task.human
        assert repr(right.response_model) == repr(task.human_model)
    else:  # the same belief
        assert repr(right.response_model) == repr(task.response_model)


def test_nothing_is_held_against_a_belief_that_is_right() -> None:
    records = evaluated(settings_for(None))
    assert len(records.tasks) == 1
    assert misjudging(records, records.tasks[0]) == []


@pytest.mark.parametrize("which", ["tau", "drifting"])
def test_the_table_says_what_it_costs(which: str, tmp_path: Path) -> None:
    records = evaluated(settings_for(which))
    task, reference = records.tasks
    assert records.reference_of(task) == reference
    assert records.reference_of(reference) is None
    assert reference.endswith("rightly assumed")
    own, right = records.of_task(task), records.of_task(reference)
    _, _, table, _ = misjudging(records, task)
    rows = [line for line in table.splitlines() if line.startswith("alignment_gain")]
    key = "greedy_alignment"
    gap = (alignment(own, key) - alignment(right, key))[..., -1].mean()
    wrong, less = (measured(each, key, "calibration")[..., -1].mean() for each in (own, right))
    assert f" {gap:+.3f} [" in rows[0]
    assert rows[0].split()[-2:] == [f"{wrong:.3f}", f"{less:.3f}"]
    write_records(tmp_path, records)
    assert tables(read_records(tmp_path / CSV)) == tables(records)


@pytest.mark.parametrize("which", ["tau", "drifting"])
def test_both_face_the_same_humans(which: str) -> None:
    settings = settings_for(which)
    task = make_task(*make_pools(settings), 4.0, settings)
    right = task.judging_rightly()
    there = {**settings, "human": settings["human"] if which == "tau" else SIMULATED}
    envs = (make_query_env(s, t, t.test, 6, 1) for s, t in ((settings, task), (there, right)))
    first, second = (draw_humans(env)["human", "omega"] for env in envs)
    assert torch.equal(first, second)


def test_two_taus_that_are_told_have_one_reference() -> None:
    settings, records = settings_for("tau"), Records()
    for tau in (4.0, 2.0, 1.0):
        records.add(evaluated(settings, tau))
    four, reference, two, one = records.tasks
    assert records.reference_of(four) == records.reference_of(two) == reference
    assert records.reference_of(one) is None


def test_a_policy_meets_the_same_humans_as_the_rest() -> None:
    settings = settings_for("skipping")
    trainer, task = trainer_of(settings)
    learned = {"policy_query": make_checkpoint(settings, task, trainer)}
    own, right = evaluate_misjudged(settings, task, learned)
    assert own.strategies == right.strategies
    assert "policy_query" in own.strategies
    # Whoever is expected says something to every question: more is learned.
    for key in own.strategies:
        less, more = (found.values(key, "information").sum() for found in (own, right))
        assert less < more
