"""What a page is told of a participant, as plain JSON: docs/study.md lists the keys.

Letters: N queries, K options per query, R possible answers, D features.
"""

from __future__ import annotations

from string import ascii_uppercase
from typing import Any

import torch

from torchrl_pref.questions.base import answers_on
from torchrl_pref.session import Session
from torchrl_pref.study.materials import Materials
from torchrl_pref.study.participant import Participant
from torchrl_pref.study.scenes import Scenes
from torchrl_pref.study.shown import ATTENTION, QUESTION, Said, Shown

DOUBTFUL = 0.5
"""An answer fits the rest badly if it is less probable than this share of one by chance."""


def state_of(person: Participant, materials: Materials, scenes: Scenes) -> dict[str, Any]:
    """All that a page shows of a participant."""
    doubtful = doubtful_answers(person)
    return {
        "phase": "end" if person.shown is None else "question",
        "code": person.code,
        "answered": len(person.said),
        "budget": materials.n_questions,
        "question": None if person.shown is None else _question(person, materials, scenes),
        "learned": _learned(person, materials, scenes, doubtful),
        "answers": [
            {
                "number": number + 1,
                "key": one.shown.key,
                "label": label_of(materials, one.said),
                "seconds": round(one.seconds, 1),
                "doubtful": one.shown.key in doubtful,
            }
            for number, one in enumerate(person.said)
        ],
        "end": None if person.ended is None else {"reason": person.ended},
    }


def label_of(materials: Materials, said: int | None) -> str:
    """What an answer in terms of places is called."""
    return "cannot say" if said is None else possible_answers(materials)[said]["label"]


def possible_answers(materials: Materials) -> list[dict[str, Any]]:
    """R answers in terms of places: what each is called, by which key it is given, and the places
    that a person points at for it."""
    n_options = materials.pool.n_options
    labels = answers_on(materials.question, n_options, torch.device("cpu")).labels
    places = materials.question.places(n_options)
    found = []
    for answer, label in enumerate(labels):
        pointed = None if places is None else list(places[answer])
        key = str(answer + 1) if places is None and answer < 9 else None
        if pointed is not None and n_options == 1:
            key = "y" if pointed else "n"
        elif pointed is not None and len(pointed) < 2:
            label = ascii_uppercase[pointed[0]] if pointed else label
            key = ascii_uppercase[pointed[0]].lower() if pointed else "="
        found.append({"answer": answer, "label": label, "key": key, "places": pointed})
    return found


def doubtful_answers(person: Participant) -> dict[str, float]:
    """By key of the question, how probable the answers are that fit the others badly."""
    if not person.questions:
        return {}
    chance = 1 / len(person.session.answers)
    likely = person.session.likelihoods.tolist()
    told = zip(person.questions, likely, strict=True)
    return {one.shown.key: each for one, each in told if each < DOUBTFUL * chance}


def best_of_pool(session: Session, materials: Materials) -> tuple[int, int]:
    """The query and the option that the belief now holds to be the best trajectory."""
    returns = materials.pool.features @ session.weights.mean
    best = int(returns.argmax())
    return best // materials.pool.n_options, best % materials.pool.n_options


def name_of_option(query: int, option: int) -> str:
    """What an option of the pool is called; numbers are those of the exported answers."""
    return f"option {ascii_uppercase[option]} of query {query} of the pool"


def _question(person: Participant, materials: Materials, scenes: Scenes) -> dict[str, Any]:
    """The open question, its options in the order in which they are shown."""
    shown = person.shown
    assert shown is not None
    return {
        "key": shown.key,
        "number": len(person.said) + 1,
        "kind": materials.settings["question"]["name"],
        "prompt": materials.question.prompt,
        "note": _note(shown, materials),
        "again": shown.again,
        "options": [scenes.of(shown.query, option) for option in shown.order],
        "answers": possible_answers(materials),
        "cannot_say": True,
    }


def _note(shown: Shown, materials: Materials) -> str | None:
    if shown.purpose != ATTENTION:
        return None
    wanted = label_of(materials, shown.wanted)
    return f"This one checks that you are reading: whatever you see, please answer “{wanted}”."


def _learned(
    person: Participant, materials: Materials, scenes: Scenes, doubtful: dict[str, float]
) -> dict[str, Any]:
    """What has been learned so far, and what the next answer is expected to add."""
    session, weights = person.session, person.session.weights
    history = session.expected_alignment.tolist()
    asks = person.shown is not None and person.shown.purpose == QUESTION
    gain = float(session.expected_gain) if asks else None
    query, option = best_of_pool(session, materials)
    return {
        "names": list(weights.names),
        "mean": weights.mean.tolist(),
        "low": weights.low.tolist(),
        "high": weights.high.tolist(),
        "sureness": history[-1],
        "expected_gain": gain,
        "worth_asking": gain is None or gain >= materials.settings["study"]["worth"],
        "history": history,
        "best": scenes.of(query, option),
        "best_label": name_of_option(query, option),
        "rationality": _rationality(person, materials),
        "doubtful": [_doubt(number, one, doubtful) for number, one in _numbered(person, doubtful)],
    }


def _numbered(person: Participant, doubtful: dict[str, float]) -> list[tuple[int, Said]]:
    numbered = enumerate(person.said, 1)
    return [(number, one) for number, one in numbered if one.shown.key in doubtful]


def _doubt(number: int, one: Said, doubtful: dict[str, float]) -> dict[str, Any]:
    key = one.shown.key
    return {"number": number, "key": key, "probability": doubtful[key]}


def _rationality(person: Participant, materials: Materials) -> dict[str, float] | None:
    """How careful the person is thought to be, where the belief infers that."""
    if not materials.response_model.is_soft:
        return None
    median, low, high = person.session.rationality.tolist()
    return None if low == high else {"median": median, "low": low, "high": high}
