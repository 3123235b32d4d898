"""What a saved session must hold, as plain JSON: structure only, not whether the numbers fit."""

from __future__ import annotations

from typing import Any

from torchrl_pref.errors import InputError

FORMAT = 1
"""Of what ``Session.to_dict`` makes."""

EARLIER = {"given": None, "setup": "query", "offers": None, "offered": None, "gone": None}
"""What sessions of earlier versions do not say of themselves."""

LARGEST = {"people": 10**5, "budget": 10**5, "offers": 10**7}
"""What a saved session can say of its sizes: nobody's memory is taken by a number in a file."""


def check_content(content: Any) -> None:
    """Refuse what ``Session.to_dict`` did not make.

    Raises:
        InputError: a part is missing or no plain number.
    """

    def numbers(rows: Any) -> bool:
        return isinstance(rows, list) and all(type(one) is int for one in rows)

    def turns(rows: Any) -> bool:
        return isinstance(rows, list) and all(map(numbers, rows))

    def size(key: str) -> bool:
        return type(content[key]) is int and 1 <= content[key] <= LARGEST[key]

    def gone_by(counts: Any) -> bool:
        """Of a feed, for each of the people; of a pool none."""
        most, people = content["offers"] or 0, content["people"] or 1
        return numbers(counts) and len(counts) == people and 0 <= min(counts) <= max(counts) <= most

    checks = {
        "format": lambda value: value == FORMAT,
        "pool": lambda value: isinstance(value, str),
        "response_model": lambda value: isinstance(value, str),
        "belief": lambda value: isinstance(value, str),
        "strategy": lambda value: isinstance(value, str),
        "repeats": lambda value: type(value) is bool,
        "budget": lambda value: size("budget"),
        "people": lambda value: value is None or size("people"),
        "seed": lambda value: type(value) is int,
        "queries": turns,
        "answers": turns,
        "given": lambda value: value is None or isinstance(value, str),
        "asked": lambda value: value is None or numbers(value),
        "setup": lambda value: value in ("query", "feed"),
        "offers": lambda value: value is None or size("offers"),
        "offered": lambda value: value is None or gone_by(value),
        "gone": lambda value: value is None or gone_by(value),
    }
    if not isinstance(content, dict):
        raise InputError(f"a session of type {type(content).__name__}: expected a dict")
    content = {**EARLIER, **content}
    for key, fits in checks.items():
        if key not in content or not fits(content[key]):
            raise InputError(
                f"{key} of a session is {content.get(key, 'missing')!s:.60}: expected what "
                f"Session.to_dict() makes, in its format {FORMAT}"
            )
    if unknown := sorted(map(str, content.keys() - checks.keys())):
        raise InputError(
            f"{unknown[0]:.60} of a session: no such key; expected what Session.to_dict() makes, "
            f"in its format {FORMAT}"
        )
    if len(content["queries"]) != len(content["answers"]):
        raise InputError("a session with a query too many or an answer: expected as many of each")
    if len(content["queries"]) + (content["asked"] is not None) > content["budget"]:
        raise InputError(
            f"a session with more questions than budget={content['budget']}: expected at most as "
            "many, the one that is asked among them"
        )
