"""What comes out of a study: tables of answers, samples, a reward for each person, a report.

Shapes: P people, M belief samples, D features, K options of a question, n answers of a person.
"""

from __future__ import annotations

import csv
import importlib.util
import io
from collections.abc import Iterable, Iterator
from pathlib import Path
from string import ascii_uppercase
from typing import Any

import numpy as np
import torch

from torchrl_pref.errors import InputError
from torchrl_pref.evaluation.records import Entry, Records, write_records
from torchrl_pref.reward import Reward
from torchrl_pref.storage.writing import replacing, write_text
from torchrl_pref.study.log import Event
from torchrl_pref.study.participant import Participant
from torchrl_pref.study.report import report_page
from torchrl_pref.study.state import label_of
from torchrl_pref.study.study import Study

FOLDER = "export"
"""In the folder of a study."""

Row = dict[str, Any]


def export_study(study: Study) -> list[Path]:
    """Write all that comes out of a study into its folder ``export``; what is there is replaced.

    The same study gives the same files, whenever that is done.

    Returns:
        The files: tables of the answers and of the records, the samples, a reward for each person
        who answered, and the report.

    Raises:
        InputError: nobody has answered yet, or the folder cannot be written.
    """
    people = [person for person in study.people.values() if person.questions]
    if not people:
        raise InputError(f"export={study.folder}: nobody has answered yet; expected an answer")
    folder = study.folder / FOLDER
    try:
        folder.mkdir(exist_ok=True)
        files = [*_write_answers(folder, answer_rows(study))]
        files += [folder / name for name in write_records(folder, records_of(study, people))]
        files += [_write_samples(folder / "samples.npz", people)]
        files += _write_rewards(folder, study, people)
        write_text(folder / "report.html", report_page(study, people))
    except OSError as error:
        raise InputError(
            f"{folder}: cannot be written ({error.strerror}); free some space there"
        ) from None
    return [*files, folder / "report.html"]


def answer_rows(study: Study) -> list[Row]:
    """Every answer that was ever given, in order, also those that were taken back."""
    # Others may answer meanwhile: no more than the people of this study know of.
    events = [one for one in study.log.events() if one.number <= study.log.last]
    asked = [one for one in events if "key" in one.content]
    by_kind: dict[str, dict[tuple[str, str], Event]] = {"shown": {}, "answer": {}, "undo": {}}
    for event in asked:
        by_kind[event.kind][event.participant, event.content["key"]] = event
    return [
        _answer_row(study, by_kind["shown"][who].content, event, who in by_kind["undo"])
        for who, event in by_kind["answer"].items()
    ]


def _answer_row(study: Study, question: dict[str, Any], event: Event, undone: bool) -> Row:
    materials, said = study.materials, event.content["said"]
    wanted, raw = question["wanted"], materials.raw.features[question["query"]]
    row: Row = {
        "participant": event.participant,
        "event": event.number,
        "at": event.at,
        "key": question["key"],
        "purpose": question["purpose"],
        "query": question["query"],
        "order": "".join(ascii_uppercase[option] for option in question["order"]),
        "said": label_of(materials, said),
        "answer": event.content["answer"],
        "seconds": round(event.content["seconds"], 3),
        "replays": event.content["replays"],
        "taken_back": undone,
        "passed": None if wanted is None else said == wanted,
    }
    for place, option in enumerate(question["order"]):
        names = zip(materials.raw.feature_names, raw[option].tolist(), strict=True)
        row |= {f"{ascii_uppercase[place]} {name}": value for name, value in names}
    return row


def _write_answers(folder: Path, rows: list[Row]) -> Iterator[Path]:
    """As CSV, and once more as Parquet where pyarrow is installed."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    with replacing(folder / "answers.csv") as partial:
        partial.write_text(text.getvalue(), encoding="utf-8", newline="")
    yield folder / "answers.csv"
    if importlib.util.find_spec("pyarrow") is not None:
        import pyarrow
        import pyarrow.parquet

        with replacing(folder / "answers.parquet") as partial:
            pyarrow.parquet.write_table(pyarrow.Table.from_pylist(rows), partial)
        yield folder / "answers.parquet"


def records_of(study: Study, people: Iterable[Participant]) -> Records:
    """The record table of an evaluation, with what is known of live people: after each number of
    answers the alignment that the belief expects, and for each answer its seconds, its number and
    how probable it is now that all are known. An entry is a person; its seed is theirs."""
    settings = study.materials.settings
    return Records(
        [
            Entry(
                protocol="study",
                task=study.materials.task_name,
                pool=study.materials.pool.digest,
                seed=person.seed,
                strategy=settings["strategy"],
                values={
                    "expected_alignment": person.session.expected_alignment[None],
                    "seconds": torch.tensor([[one.seconds for one in person.questions]]),
                    "answer": torch.tensor(
                        [[-1.0 if one.answer is None else one.answer for one in person.questions]]
                    ),
                    "likelihood": person.session.likelihoods[None],
                },
            )
            for person in people
        ]
    )


def _write_samples(path: Path, people: Iterable[Participant]) -> Path:
    """The belief's samples (P M D), and whose they are."""
    codes = np.array([person.code for person in people])
    samples = torch.stack([person.session.samples for person in people]).numpy()
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez(file, participants=codes, samples=samples)
    return path


def _write_rewards(folder: Path, study: Study, people: list[Participant]) -> Iterator[Path]:
    """A reward for each person; of one alone it is ``reward.json``. That of an earlier export, when
    more or fewer people had answered, is removed: it would be taken for one of now."""
    written = set()
    for person in people:
        name = "reward.json" if len(people) == 1 else f"reward-{person.code}.json"
        origin = {"participant": person.code, "task": study.materials.task_name}
        Reward.of(person.session, origin=origin).save(folder / name)
        written.add(name)
        yield folder / name
    for name in {"reward.json", *(f"reward-{code}.json" for code in study.people)} - written:
        (folder / name).unlink(missing_ok=True)
