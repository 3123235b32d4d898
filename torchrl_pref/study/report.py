"""The report of a study: one page of HTML that needs nothing else, its figures inside it.

Letters: D features, n answers of a person.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from html import escape

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from torchrl_pref.errors import InputError
from torchrl_pref.study.participant import Participant
from torchrl_pref.study.shown import ATTENTION, REPEAT
from torchrl_pref.study.state import best_of_pool, doubtful_answers, label_of, name_of_option
from torchrl_pref.study.study import Study
from torchrl_pref.tasks.drawing import picture_of

BLUE, GREY = "#1d5a96", "#7b8794"

COLOURS = ("#1d5a96", "#c65b12", "#2b8a5a", "#8a4f9e", "#b08a00", "#4d4d4d")
"""Of people beside each other, again and again."""

STYLE = """
body { max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #1c2430;
  font: 16px/1.5 system-ui, "DejaVu Sans", sans-serif; }
h2 { margin-top: 2.5rem; padding-top: 1rem; border-top: 1px solid #cfd5dc; }
img { max-width: 100%; }
table { border-collapse: collapse; }
th, td { padding: .2rem .8rem .2rem 0; text-align: left; font-variant-numeric: tabular-nums; }
th { font-weight: 500; color: #545f6d; }
.side { display: grid; grid-template-columns: 1fr 18rem; gap: 2rem; align-items: start; }
figure { margin: 0; max-width: 18rem; }
figure img { max-height: 20rem; }
"""


def report_page(study: Study, people: Sequence[Participant]) -> str:
    """What was learned of each person who answered, and how they answered.

    Args:
        study: of the people.
        people: those who answered a question.
    """
    title = study.materials.settings["study"]["title"]
    parts = [f"<h1>{escape(title)}</h1>", f"<p>{escape(_about(study, people))}</p>"]
    if len(people) > 1:
        figure = weights_figure(people)
        parts += ["<h2>Everybody</h2>", _image(figure, "The weights of everybody, with intervals")]
    for person in people:
        parts += _of_person(study, person)
    return (
        '<!doctype html>\n<html lang="en">\n<head><meta charset="utf-8">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head>\n<body>\n"
        + "\n".join(parts)
        + "\n</body>\n</html>\n"
    )


def _about(study: Study, people: Sequence[Participant]) -> str:
    settings = study.materials.settings
    answers = sum(len(person.said) for person in people)
    return (
        f"{len(people)} {'person' if len(people) == 1 else 'people'} gave {answers} answers to "
        f"questions of the kind “{settings['question']['name']}” about the task "
        f"“{study.materials.task_name}”. Checks are counted among the answers, and teach nothing. "
        "Weights are of normalised features; whatever they are, the squares of all sum to 1. Shown "
        "are their means, and intervals that hold 90% of what is still thought possible."
    )


def _of_person(study: Study, person: Participant) -> list[str]:
    """The part of the page on one person."""
    rows = "".join(
        f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>"
        for name, text in facts(study, person).items()
    )
    query, option = best_of_pool(person.session, study.materials)
    return [
        f"<h2>{escape(person.code)}</h2>",
        _image(person_figure(person), f"Weights, certainty and times of {person.code}"),
        f'<div class="side"><table>{rows}</table>',
        _best(study, query, option),
        "</div>",
    ]


def _best(study: Study, query: int, option: int) -> str:
    """The trajectory that is thought best."""
    caption = f"Thought to be the best: {name_of_option(query, option)}."
    try:
        picture = _image(picture_of(study.materials.scene(query, option)), caption)
    except InputError as error:  # an image file that is gone
        picture = f"<p>{escape(str(error))}</p>"
    return f"<figure>{picture}<figcaption>{escape(caption)}</figcaption></figure>"


def facts(study: Study, person: Participant) -> dict[str, str]:
    """How a person answered, in words."""
    by_key = {one.shown.key: (number, one) for number, one in enumerate(person.said, 1)}
    checks = [one.passed for one in person.said if one.shown.purpose == ATTENTION]
    again = [
        by_key[one.shown.of][1].answer == one.answer
        for one in person.said
        if one.shown.purpose == REPEAT and one.shown.of in by_key
    ]
    doubtful = [
        f"number {by_key[key][0]} ({label_of(study.materials, by_key[key][1].said)}, probability "
        f"{each:.2f})"
        for key, each in doubtful_answers(person).items()
    ]
    minutes = sum(one.seconds for one in person.said) / 60
    found = {
        "answers": f"{len(person.said)} of {study.materials.n_questions}, in {minutes:.1f} minutes",
        "could not say": str(sum(one.said is None for one in person.said)),
        "how well they are known": f"{100 * float(person.session.expected_alignment[-1]):.0f} of "
        "100 (the alignment that the belief expects)",
        "answers that fit badly": "; ".join(doubtful) or "none",
    }
    if checks:
        found["attention checks passed"] = f"{sum(map(bool, checks))} of {len(checks)}"
    if again:
        found["the same again"] = f"{sum(again)} of {len(again)} repeated questions"
    if study.materials.response_model.is_soft:
        median, low, high = person.session.rationality.tolist()
        found["care (tau)"] = f"{median:.2g}, from {low:.2g} to {high:.2g}"
    return found


def weights_figure(people: Sequence[Participant]) -> Figure:
    """The weights of several people beside each other."""
    names = people[0].session.weights.names
    each = 0.8 / len(people)
    figure, (axes,) = _figure((8.0, 1.2 + len(names) * max(0.45, 0.16 * len(people))), 1)
    for number, person in enumerate(people):
        offset = (number + 0.5) * each - 0.4
        _draw_weights(axes, person, COLOURS[number % len(COLOURS)], offset)
    figure.legend(loc="outside upper center", ncols=6, frameon=False)
    return figure


def person_figure(person: Participant) -> Figure:
    """The weights of a person, how well they became known, and how long answers took."""
    n_features = person.session.pool.n_features
    figure, (weights, known, times) = _figure((10.5, max(2.8, 1 + 0.42 * n_features)), 3)
    _draw_weights(weights, person, BLUE, 0.0)
    weights.set_title("weights")
    history = person.session.expected_alignment.tolist()
    known.plot(range(len(history)), history, color=BLUE, marker="o", markersize=3)
    known.set(title="how well they are known", xlabel="answers", ylim=(0, 1))
    seconds = [one.seconds for one in person.said]
    times.bar(range(1, len(seconds) + 1), seconds, color=GREY)
    times.set(title="seconds for an answer", xlabel="answer")
    for axes in (known, times):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def _draw_weights(axes: Axes, person: Participant, colour: str, offset: float) -> None:
    """Means with intervals, a row for each of D features."""
    weights = person.session.weights
    mean, low, high = (part.tolist() for part in weights[:1] + weights[2:4])
    rows = [row + offset for row in range(len(mean))]
    axes.axvline(0, color=GREY, linewidth=0.8)
    axes.hlines(rows, low, high, color=colour, linewidth=2.5, alpha=0.55)
    axes.plot(mean, rows, "o", color=colour, markersize=5, label=f" {person.code}")
    axes.set(xlim=(-1.05, 1.05), ylim=(len(mean) - 0.5, -0.5))
    axes.set_yticks(range(len(mean)), weights.names, parse_math=False)


def _figure(size: tuple[float, float], panels: int) -> tuple[Figure, list[Axes]]:
    """A figure with so many panels in a row."""
    figure = Figure(size, 110, layout="constrained")
    FigureCanvasAgg(figure)
    found = figure.subplots(1, panels, squeeze=False)[0].tolist()
    for axes in found:
        axes.spines[["top", "right"]].set_visible(False)
    return figure, found


def _image(figure: Figure, description: str) -> str:
    """A figure as part of the page."""
    file = io.BytesIO()
    figure.savefig(file, format="png", metadata={"Software": None})
    content = base64.b64encode(file.getvalue()).decode()
    return f'<img src="data:image/png;base64,{content}" alt="{escape(description)}">'
