"""What every strategy is called and how it is drawn, wherever it is shown; nothing else decides.

A strategy is known by its *key*, which stays the same in every file: its kind, and where there are
several of a kind, after a colon which one (``policy_query:attention``, ``threshold:0.15``,
``own:mine:Rule``). Names, colours and lines are for readers, and no code asks for them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from matplotlib.figure import Figure


class Style(NamedTuple):
    """The look of a strategy."""

    name: str
    """In tables and legends."""
    color: str
    line: str


class Kind(NamedTuple):
    """What is known of a kind of strategy."""

    style: Style
    batch: bool = False
    """Whether it chooses several queries to be asked at once."""
    feed: bool = False
    """Whether it decides on the offers of a feed, and does not choose from the whole pool."""
    baseline: str | None = None
    """The kind that it has to be better than: what it is held against in tables."""
    drawn: bool = True
    """Whether figures of many strategies show it; tables show all."""
    typed: str | None = None
    """What ``strategy=`` calls the same in its setup, where it has a name for it."""


KINDS: dict[str, Kind] = {
    "random": Kind(Style("random", "#7f7f7f", "--"), typed="random"),
    "greedy_information": Kind(
        Style("information_gain", "#1f1f1f", "-"), baseline="random", typed="information_gain"
    ),
    "greedy_many_samples": Kind(
        Style("information_gain", "#1f1f1f", ":"),
        baseline="greedy_information",
        drawn=False,
    ),
    "greedy_no_repeats": Kind(
        Style("information_gain, no repeats", "#1f1f1f", "--"),
        baseline="greedy_information",
        drawn=False,
    ),
    "lookahead": Kind(
        Style("lookahead", "#8c510a", "-"),
        baseline="greedy_information",
        drawn=False,
        typed="lookahead",
    ),
    "volume_removal": Kind(
        Style("volume_removal", "#8c510a", "--"),
        baseline="greedy_information",
        drawn=False,
        typed="volume_removal",
    ),
    "greedy_alignment": Kind(
        Style("alignment_gain", "#009e73", "-"),
        baseline="greedy_information",
        typed="alignment_gain",
    ),
    "batch_top": Kind(Style("top", "#1f1f1f", "--"), batch=True, baseline="random"),
    "batch_medoids": Kind(Style("medoids", "#8c510a", "-"), batch=True, baseline="batch_top"),
    "batch_boundary_medoids": Kind(
        Style("boundary_medoids", "#e69f00", "-"), batch=True, baseline="batch_top"
    ),
    "batch_successive_elimination": Kind(
        Style("successive_elimination", "#0072b2", "-."), batch=True, baseline="batch_top"
    ),
    "batch_dpp": Kind(Style("dpp", "#cc79a7", "-"), batch=True, baseline="batch_top"),
    "batch_joint": Kind(Style("joint", "#009e73", "-."), batch=True, baseline="batch_top"),
    "ask_all": Kind(Style("ask all", "#000000", ":"), feed=True, typed="random"),
    "threshold": Kind(Style("threshold in bits", "#e69f00", "-."), feed=True, baseline="ask_all"),
    "quantile_information": Kind(
        Style("information_gain, feed", "#5e3c99", "-."),
        feed=True,
        baseline="ask_all",
        typed="information_gain",
    ),
    "quantile_alignment": Kind(
        Style("alignment_gain, feed", "#cc79a7", "-."),
        feed=True,
        baseline="ask_all",
        typed="alignment_gain",
    ),
    "quantile_both": Kind(
        Style("information_gain then alignment_gain, feed", "#882255", "--"),
        feed=True,
        baseline="quantile_alignment",
        drawn=False,
    ),
    "policy_query": Kind(Style("RL", "#0072b2", "-"), baseline="greedy_alignment"),
    "policy_feed": Kind(Style("RL-feed", "#d55e00", "-"), feed=True, baseline="quantile_alignment"),
    "start": Kind(Style("the policy before training", "#56b4e9", "--")),
    "own": Kind(Style("own", "#aa4499", "-")),
}
"""By kind. The colours begin with Okabe and Ito's, told apart by colour-blind readers; ``RL`` and
``RL-feed`` are the paper's names; ``own`` are strategies of the user, in either setup. Names are
those that ``strategy=`` has, where it has one."""

SPARE = (
    ("#aa4499", "-"),
    ("#999933", "-"),
    ("#661100", "-"),
    ("#88ccee", "-"),
    ("#6699cc", "--"),
    ("#117733", "--"),
    ("#ddaa33", "--"),
)
"""Colours and lines for strategies of the user and for the second and later ones of a kind."""

OLD_KEYS = {
    "greedy": "greedy_information",
    "greedy alignment": "greedy_alignment",
    "quantile": "quantile_alignment",
}
"""Checkpoints hold the baseline of their training under these names."""

LEARNED = ("policy_query", "policy_feed")


def kind_of(key: str) -> str:
    """The kind of a strategy."""
    return OLD_KEYS.get(key, key).partition(":")[0]


def is_judged(key: str) -> bool:
    """Whether a strategy is there to be judged, and not as a baseline: a policy or the user's."""
    return kind_of(key) in (*LEARNED, "own")


def is_drawn(key: str) -> bool:
    """Whether a figure of many strategies shows it."""
    return KINDS[kind_of(key)].drawn


def is_feed(key: str, beside: Iterable[str]) -> bool:
    """Whether a strategy decides on offers; one of the user does where others beside it do."""
    kinds = [kind_of(key)] if kind_of(key) != "own" else map(kind_of, beside)
    return any(KINDS[kind].feed for kind in kinds)


def is_there(typed: str, feed: bool, beside: Iterable[str]) -> bool:
    """Whether what ``strategy=`` calls so, in a feed or not, is a baseline beside it already."""
    kinds = [KINDS[kind_of(key)] for key in beside]
    return any(kind.typed == typed and kind.feed == feed for kind in kinds)


def baseline_of(key: str, beside: Iterable[str]) -> str | None:
    """The key of the strategy that one has to be better than, among those beside it.

    One of the user has the baseline of the policies of its setup.
    """
    beside, kind = list(beside), kind_of(key)
    if kind == "own":
        kind = "policy_feed" if is_feed(key, beside) else "policy_query"
    wanted = KINDS[kind].baseline
    return next((other for other in beside if kind_of(other) == wanted), None)


def name_of(key: str) -> str:
    """What a strategy is called."""
    key = OLD_KEYS.get(key, key)
    kind, _, which = key.partition(":")
    if kind == "own":
        return which
    return f"{KINDS[kind].style.name} ({which})" if which else KINDS[kind].style.name


def styles_of(keys: Iterable[str]) -> dict[str, Style]:
    """The style of each strategy of a report, by key: of a kind the first has the kind's own.

    Args:
        keys: of all strategies of the report, so that each looks alike in all of its panels.
    """
    styles: dict[str, Style] = {}
    spare, taken = iter(SPARE * 20), set()
    for key in dict.fromkeys(keys):
        kind = kind_of(key)
        color, line = KINDS[kind].style[1:]
        if kind == "own" or (kind in taken and kind in LEARNED):
            color, line = next(spare)
        taken.add(kind)
        styles[key] = Style(name_of(key), color, line)
    return styles


def legend_above(figure: Figure, styles: Mapping[str, Style]) -> None:
    """One legend for all panels of a figure with a constrained layout, above them: it covers none.

    Args:
        figure: its curves are labelled by the keys of their strategies.
        styles: by key, in the order of the legend.
    """
    handles: dict[str, Any] = {}
    for axis in figure.axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    shown = [key for key in styles if key in handles]
    # Inches of the longest name and its line, about: a legend that is too wide is cut off.
    longest = 0.7 + 0.09 * max(len(styles[key].name) for key in shown)
    columns = max(1, int(figure.get_figwidth() / longest))
    figure.set_figheight(figure.get_figheight() + 0.22 * math.ceil(len(shown) / columns))
    figure.legend(
        handles=[handles[key] for key in shown],
        labels=[styles[key].name for key in shown],
        loc="outside upper center",
        ncols=min(len(shown), columns),
        frameon=False,
    )
