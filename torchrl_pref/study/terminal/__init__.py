"""A person answers in the terminal.

What they say goes the same way as from the page: into the log first, by
:class:`participant.Participant`.
"""

from __future__ import annotations

import sys

from torchrl_pref.errors import InputError
from torchrl_pref.study.participant import Participant
from torchrl_pref.study.study import Study
from torchrl_pref.study.terminal.conversation import Conversation, instruct, say, surely
from torchrl_pref.study.terminal.files import QuestionFiles

FOLDER = "question"
"""In the folder of a study: the open question as files."""


def converse(study: Study, code: str) -> None:
    """Ask a person in the terminal, until there is no question left or they stop.

    The end of the input and Ctrl-C stop as well. Whatever was answered is in the log.

    Args:
        study: what is asked.
        code: the person's; who was there before goes on where they were.

    Raises:
        InputError: nobody may be called that, or the terminal lacks letters to draw with.
    """
    check_letters()
    if not study.may_join(code):
        raise InputError(f"participant={code}: {_expected(study)}")
    files = QuestionFiles(study.folder / FOLDER)
    try:
        if code in study.people or _welcome(study):
            print("One moment …")
            study.think_ahead()
            person = surely(study, lambda: _join(study, code))
            Conversation(study, person, files).hold()
    except EOFError:
        print()
    except KeyboardInterrupt as stop:
        print()
        if type(stop) is not KeyboardInterrupt:  # no Ctrl-C, but SIGTERM: the program's to handle
            raise
    finally:
        files.close()


def check_letters() -> None:
    """Refuse a terminal that lacks letters to draw with.

    Raises:
        InputError: it does.
    """
    encoding = sys.stdout.encoding or "ascii"
    try:
        "⣿▒●…".encode(encoding)
    except UnicodeEncodeError:
        raise InputError(
            f"ui=terminal: letters are printed as {encoding} here, which has none to draw with; "
            "expected UTF-8; set PYTHONUTF8=1, or type ui=browser"
        ) from None


def _expected(study: Study) -> str:
    """Who may join."""
    named = study.materials.settings["study"]["participants"]
    if named is not None:
        return f"expected one of {', '.join(named)}, whom study.participants names"
    return (
        "expected a code of up to 32 letters, digits, - and _, as in participant=P1; a study that "
        "is full takes nobody new"
    )


def _join(study: Study, code: str) -> Participant:
    """The person, who goes on if they had stopped."""
    person = study.join(code)
    assert person is not None
    person.go_on()
    return person


def _welcome(study: Study) -> bool:
    """What a person reads first; whether they take part."""
    settings = study.materials.settings["study"]
    print()
    say(settings["title"])
    print()
    instruct(study)
    say(
        f"Of questions about what you like there are at most {study.materials.n_questions}. "
        "There is no right answer. Every answer is saved at once; you can take any of them back, "
        "and stop whenever you like. Type a line, then Enter; h lists what you can type."
    )
    while settings["consent"]:
        said = input("Have you read this, and do you agree to take part? (y or n) ")
        if said.strip().lower() in ("y", "yes"):
            break
        if said.strip().lower() in ("n", "no"):
            say("Then you are asked nothing, and nothing about you is kept.")
            return False
    return True
