"""What it costs that a belief takes the human for another: once more where it is right."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch

from torchrl_pref.build import USUAL_HUMAN, make_query_env
from torchrl_pref.checkpoints.checkpoint import Checkpoint
from torchrl_pref.config.sections import Settings
from torchrl_pref.errors import InputError
from torchrl_pref.evaluation.comparison import evaluate_task, try_strategies
from torchrl_pref.evaluation.own import Maker
from torchrl_pref.evaluation.records import MISJUDGED, REFERENCE, Records
from torchrl_pref.evaluation.run import draw_humans
from torchrl_pref.pool import QueryPool
from torchrl_pref.problem import Problem


def evaluate_misjudged(
    settings: Settings,
    task: Problem,
    learned: Mapping[str, Checkpoint],
    test: QueryPool | None = None,
    own: Mapping[str, Maker] | None = None,
) -> Records:
    """``comparison.evaluate_task``; and where the belief takes the human for another, the same
    strategies with the same people where it does not, in whom then nothing is particular that it
    cannot know of. What cannot be so is left out, see :func:`judged_rightly`.

    Args:
        settings, task, learned, test, own: as there.
    """
    found = judged_rightly(settings, task, own or {})
    if found is None:
        return evaluate_task(settings, task, learned, test, own)
    records = evaluate_task(settings, task, learned, test, own, MISJUDGED)
    there, right = found
    learned = {
        key: replace(one, settings={**one.settings, "human": there["human"]})
        for key, one in learned.items()
    }
    title = f"{right.title}, rightly assumed (not {', not '.join(task.mistakes)})"
    records.entries += evaluate_task(there, right, learned, test, own, REFERENCE, title).entries
    return records


def judged_rightly(
    settings: Settings, task: Problem, own: Mapping[str, Maker]
) -> tuple[Settings, Problem] | None:
    """Settings and task in which the belief is right about the people; None where it is so anyhow,
    where it refuses such people (``rationality`` those who never err), or where people in whom
    nothing is particular would want something else (a human of the user's own who draws ω)."""
    if not task.mistakes:
        return None
    right = task.judging_rightly()
    there: Settings = {**settings, "human": USUAL_HUMAN}
    try:
        try_strategies(own, there, right)
        envs = (make_query_env(s, t, t.test, 2, 0) for s, t in ((settings, task), (there, right)))
        wanted = [draw_humans(env)["human", "omega"] for env in envs]
    except InputError:
        return None
    return (there, right) if torch.equal(*wanted) else None
