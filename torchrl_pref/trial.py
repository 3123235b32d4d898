"""Settings tried out before anything is made of them: what no table can check.

What somebody brings (a task, a question, a human, a belief) is made here once, so that what is
wrong with it is told before there is a folder.
"""

from __future__ import annotations

from torchrl_pref.build import ANSWERING, refuse_own_pools, weigh_steps
from torchrl_pref.config.sections import Settings
from torchrl_pref.errors import InputError
from torchrl_pref.groups import find, make
from torchrl_pref.pool import QueryPool
from torchrl_pref.questions.base import Question
from torchrl_pref.questions.responses import model_of
from torchrl_pref.tasks.base import make_pool
from torchrl_pref.typed_code import where


def check_groups(settings: Settings) -> None:
    """Refuse groups that cannot be made, before anything else is.

    Raises:
        InputError: one cannot.
    """
    section = settings["question"]
    question: Question = make("question", section)
    try:
        _check_made(settings, question)
    except InputError as error:
        # The library knows what was made, and not what was typed for it.
        named = f"question={section.get('make') or section['name']}"
        raise InputError(str(error).replace(repr(question), named)) from None


def _check_made(settings: Settings, question: Question) -> None:
    """See :func:`check_groups`, for what can be answered."""
    own_pools = settings["pool"]["train"] is not None
    n_options = None if own_pools else settings["pool"]["options"]
    tried = None
    if n_options is not None:
        question.answers(n_options)
        tried = _try_task(settings)
    taus = settings["tau"] if isinstance(settings["tau"], list) else [settings["tau"]]
    for tau in taus:
        human, belief = settings["human"], settings["belief"]
        own = tau if human["tau"] is None else human["tau"]
        for group, section, known in (("human", human, own), ("belief", belief, tau)):
            number = None if known == "optimal" else 1.0 if known == "noisy" else float(known)
            model = model_of(number, question, section["lapse"])
            if n_options is not None:
                model.n_answers(n_options)  # or it is refused here
            made = make(group, section, model, without=ANSWERING)
            if group == "human" and tried is not None:
                weigh_steps(settings, made, tried)
            elif group == "human":
                refuse_own_pools(settings, made)
    if settings.get("policy", {}).get("name", "pretrained") != "pretrained":
        find("policy", settings["policy"])


def _try_task(settings: Settings) -> QueryPool:
    """Make the task, and a query about it.

    Raises:
        InputError: it cannot be made, or fails.
    """
    task = make("task", settings["task"])
    try:
        return make_pool(task, 1, settings["pool"]["options"], seed=0)
    except InputError:
        raise
    except Exception as error:
        named = settings["task"].get("make", settings["task"]["name"])
        raise InputError(
            f"task={named}: its first trajectories fail ({where(error)}); mend it, or its settings"
        ) from error
