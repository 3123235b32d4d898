"""What it costs that a belief takes the human for another: held against a belief that is right."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import settings_of, trainer_of

from torchrl_pref.build import USUAL_HUMAN, make_pools, make_query_env, make_task
from torchrl_pref.evaluation.misjudged import evaluate_misjudged, judged_rightly
from torchrl_pref.evaluation.records import CSV, Records, read_records, write_records
from torchrl_pref.evaluation.run import draw_humans
from torchrl_pref.evaluation.tables import misjudging, tables
from torchrl_pref.evaluation.views import alignment, measured
from torchrl_pref.humans import HUMANS
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.problem import Problem
from torchrl_pref.training.start import make_checkpoint

OTHERS: dict[str, dict[str, Any]] = {
    "tau": {"human": {**USUAL_HUMAN, "tau": 1.0}},
    "lapse": {"human": {**USUAL_HUMAN, "lapse": 0.2}},
    "no lapse": {"belief.lapse": 0.2},
    "spread": {"human": {**USUAL_HUMAN, "spread": 4.0}},
    "never errs": {"human": {**USUAL_HUMAN, "tau": "optimal"}},
    "skipping": {"human": {"name": "skipping", "threshold": 0.0, "tau": None, "lapse": 0.0}},
    "drifting": {"human": {"name": "drifting", "drift": 0.1, "tau": 1.0, "lapse": 0.0}},
}


def settings_for(which: str | None, **setup: Any) -> dict[str, Any]:
    settings = settings_of("query")
    settings["setup"] |= {"budget": 4, **setup}
    settings["evaluation"] |= {"humans": 6, "metrics": ["calibration"]}
    for key, value in ({} if which is None else OTHERS[which]).items():
        section, _, name = key.partition(".")
        settings[section] = {**settings[section], name: value} if name else value
    return settings


def task_of(settings: dict[str, Any], tau: Any = 4.0) -> Problem:
    return make_task(*make_pools(settings), tau, settings)


def evaluated(settings: dict[str, Any], tau: Any = 4.0) -> Records:
    return evaluate_misjudged(settings, task_of(settings, tau), {})


@pytest.mark.parametrize("tau", [4.0, "optimal"])
@pytest.mark.parametrize("which", OTHERS)
def test_the_belief_is_told_what_it_can_be_told(which: str, tau: Any) -> None:
    settings = settings_for(which)
    task = task_of(settings, tau)
    if which == "never errs" and tau == "optimal":
        assert not task.mistakes
        return
    found = judged_rightly(settings, task, {})
    assert found is not None
    _, right = found
    assert task.mistakes
    assert "; assumed" in task.title
    assert not right.mistakes
    assert repr(right.human_model) == repr(task.human_model) == repr(right.response_model)


@pytest.mark.parametrize("which", OTHERS)
def test_both_face_people_who_want_the_same(which: str) -> None:
    settings = settings_for(which)
    task = task_of(settings)
    found = judged_rightly(settings, task, {})
    assert found is not None
    wanted = [
        draw_humans(make_query_env(s, t, t.test, 6, 1))["human", "omega"]
        for s, t in ((settings, task), found)
    ]
    assert torch.equal(*wanted)


def test_nothing_is_held_against_a_belief_that_is_right() -> None:
    records = evaluated(settings_for(None))
    assert [entry.protocol for entry in records.entries] == ["comparison"] * 3
    assert misjudging(records, records.tasks[0]) == []


@pytest.mark.parametrize("name", ["rationality", "laplace"])
def test_a_belief_that_refuses_such_people_is_held_against_nothing(name: str) -> None:
    settings = settings_for("never errs")
    settings["belief"] = {"name": name, "samples": 20, "lapse": 0.0}
    settings["belief"] |= {"spread": 3.0, "moves": None} if name == "rationality" else {}
    records = evaluated(settings)
    assert len(records.tasks) == 1
    assert misjudging(records, records.tasks[0]) == []


def test_humans_who_draw_for_themselves_are_held_against_nobody(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Own(SimulatedHuman):
        def draw(self, *arguments: Any) -> Any:
            drawn = super().draw(*arguments)
            drawn["omega"] = drawn["omega"].flip(-1)
            return drawn

    monkeypatch.setitem(HUMANS, "skipping", lambda model, threshold: Own(model))
    records = evaluated(settings_for("skipping"))
    assert len(records.tasks) == 1


@pytest.mark.parametrize("which", ["tau", "drifting"])
def test_the_table_says_what_it_costs(which: str, tmp_path: Path) -> None:
    records = evaluated(settings_for(which))
    task, reference = records.tasks
    assert records.reference_of(task) == reference
    assert records.reference_of(reference) is None
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


def test_each_is_held_against_its_own() -> None:
    """Two taus of one kind of human, one that is right, and what follows it."""
    records = Records()
    for which, tau in (("tau", 4.0), ("tau", 2.0), ("tau", 1.0), ("skipping", 2.0)):
        records.entries += evaluated(settings_for(which), tau).entries
    four, of_four, two, of_two, one, skipping, of_skipping = records.tasks
    found = [records.reference_of(task) for task in (four, two, one, skipping)]
    assert found == [of_four, of_two, None, of_skipping]
    assert of_four == "noisy human (tau=1), rightly assumed (not tau=4)"
    assert of_skipping == "noisy human (tau=2), rightly assumed (not skipping threshold=0.0)"


def test_each_pool_is_held_against_itself() -> None:
    settings = settings_for("tau", candidates=None)
    settings["policy"] = {**settings_of("query", "paper")["policy"]}
    trainer, task = trainer_of(settings)
    learned = {"policy_query": make_checkpoint(settings, task, trainer)}
    records = evaluate_misjudged(settings, task, learned)
    held_out, training, *references = records.tasks
    assert [records.reference_of(task) for task in (held_out, training)] == references
    assert [name.rpartition(", ")[2] for name in references] == ["held-out pool", "training pool"]


def test_a_policy_meets_the_same_humans_as_the_rest() -> None:
    settings = settings_for("skipping")
    trainer, task = trainer_of(settings)
    learned = {"policy_query": make_checkpoint(settings, task, trainer)}
    records = evaluate_misjudged(settings, task, learned)
    own, right = (records.of_task(each) for each in records.tasks)
    assert own.strategies == right.strategies
    assert "policy_query" in own.strategies
    # Who skips nothing says something to every question: more is learned.
    for key in own.strategies:
        less, more = (found.values(key, "information").sum() for found in (own, right))
        assert less < more
