"""What comes out of a study, read again as somebody would who has the files alone."""

from __future__ import annotations

import csv
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch
from study_helpers import answer_all, careful, study_of

from torchrl_pref import QueryPool, Reward
from torchrl_pref.errors import InputError
from torchrl_pref.evaluation.records import read_records
from torchrl_pref.study.export import export_study
from torchrl_pref.study.participant import Participant
from torchrl_pref.study.report import facts
from torchrl_pref.study.shown import REPEAT
from torchrl_pref.study.study import Study

OMEGA = torch.tensor([0.8, -0.6, 0.0, 0.0])


def answered(study: Study, *codes: str) -> Study:
    """A study in which somebody of each code answered all questions."""
    for code in codes or ("P1",):
        person = study.join(code)
        assert person is not None
        answer_all(person, careful(OMEGA))
    return study


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "export" / "answers.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_every_answer_is_there_as_it_was_given(tmp_path: Path) -> None:
    study = answered(study_of(tmp_path, "study.attention=1", "study.repeats=1"))
    person, raw = study.people["P1"], study.materials.raw.features
    export_study(study)
    rows = table(tmp_path)
    assert len(rows) == len(person.said) == 8
    for row, one in zip(rows, person.said, strict=True):
        assert (row["key"], row["purpose"]) == (one.shown.key, one.shown.purpose)
        assert int(row["query"]) == one.shown.query
        assert int(row["answer"]) == one.answer
        assert one.said is not None
        assert row["said"] == "AB"[one.said]
        assert row["order"] == "".join("AB"[option] for option in one.shown.order)
        assert float(row["seconds"]) == one.seconds
        assert row["taken_back"] == "False"
        assert row["passed"] == ("" if one.passed is None else str(one.passed))
        # A is what the person saw first.
        seen = [float(row[f"A {name}"]) for name in study.materials.raw.feature_names]
        assert torch.equal(torch.tensor(seen), raw[one.shown.query, one.shown.order[0]])
    study.close()


def test_what_was_taken_back_is_marked(tmp_path: Path) -> None:
    study = answered(study_of(tmp_path))
    person = study.people["P1"]
    key = person.said[2].shown.key
    person.undo(key)
    export_study(study)
    rows = table(tmp_path)
    assert [row["key"] for row in rows if row["taken_back"] == "True"] == [key]
    answer_all(person, careful(-OMEGA))
    export_study(study)
    rows = table(tmp_path)
    assert len(rows) == 7
    assert [row["key"] for row in rows if row["taken_back"] == "True"] == [key]
    study.close()


def test_reward_samples_and_records_are_the_belief(tmp_path: Path) -> None:
    study = answered(study_of(tmp_path), "P1", "second")
    files = export_study(study)
    assert all(path.parent == tmp_path / "export" for path in files)
    assert sorted(files) == sorted((tmp_path / "export").iterdir())
    with np.load(tmp_path / "export" / "samples.npz") as stored:
        samples = dict(zip(stored["participants"].tolist(), stored["samples"], strict=True))
    records = read_records(tmp_path / "export" / "records.csv.gz")
    for entry, (code, person) in zip(records.entries, study.people.items(), strict=True):
        session = person.session
        assert np.array_equal(samples[code], session.samples.numpy())
        reward = Reward.load(tmp_path / "export" / f"reward-{code}.json")
        raw = study.materials.raw.features[:, 0]
        assert torch.equal(reward.score(raw)[0], session.score(raw)[0])
        assert reward.origin["participant"] == code
        assert entry.seed == person.seed
        told = entry.values["expected_alignment"][0]
        assert torch.allclose(told, session.expected_alignment, atol=1e-6)
    study.close()


def test_one_person_leaves_one_reward(tmp_path: Path) -> None:
    study = answered(study_of(tmp_path))
    study.join("nobody")  # who came, and did not answer
    export_study(study)
    assert [path.name for path in (tmp_path / "export").glob("reward*")] == ["reward.json"]
    study.close()


def test_no_reward_of_an_earlier_export_is_left(tmp_path: Path) -> None:
    """Of one person first, of two then, and of one again."""
    study = answered(study_of(tmp_path))
    for code, names in (
        ("P1", ["reward.json"]),
        ("P2", ["reward-P1.json", "reward-P2.json"]),
    ):
        answered(study, code)
        export_study(study)
        assert sorted(one.name for one in (tmp_path / "export").glob("reward*")) == names
    for one in list(study.people["P2"].said):
        study.people["P2"].undo(one.shown.key)
    export_study(study)
    assert [one.name for one in (tmp_path / "export").glob("reward*")] == ["reward.json"]
    study.close()


def test_a_pool_from_a_file_is_not_said_to_be_of_a_task(tmp_path: Path) -> None:
    QueryPool(torch.rand(20, 2, 3)).save(tmp_path / "pool.pt")
    study = study_of(tmp_path, f"pool.file={tmp_path / 'pool.pt'}")
    person = study.join("P1")
    assert person is not None
    answer_all(person, lambda person: 0)
    export_study(study)
    folder = tmp_path / "export"
    assert Reward.load(folder / "reward.json").origin["task"] == "own"
    assert read_records(folder / "records.csv.gz").tasks == ["own"]
    assert "gridworld" not in (folder / "report.html").read_text(encoding="utf-8")
    study.close()


@pytest.mark.parametrize(("again", "told"), [(0, "1 of 1"), (1, "0 of 1")])
def test_the_report_tells_whether_the_same_was_said_again(
    tmp_path: Path, again: int, told: str
) -> None:
    study = study_of(tmp_path, "study.repeats=1")
    person = study.join("P1")
    assert person is not None

    def choose(person: Participant) -> int:
        """The first option of each query, and of the repetition the one that is asked for."""
        assert person.shown is not None
        return person.shown.order.index(again if person.shown.purpose == REPEAT else 0)

    answer_all(person, choose)
    assert facts(study, person)["the same again"] == f"{told} repeated questions"
    study.close()


def test_the_same_study_gives_the_same_files(tmp_path: Path) -> None:
    study = answered(study_of(tmp_path), "P1", "P2")
    before = {path.name: path.read_bytes() for path in export_study(study)}
    study.close()
    again = study_of(tmp_path)  # rebuilt from its log
    assert {path.name: path.read_bytes() for path in export_study(again)} == before
    again.close()


def test_without_an_answer_there_is_nothing_to_write(tmp_path: Path) -> None:
    study = study_of(tmp_path)
    study.join("P1")
    with pytest.raises(InputError, match="nobody has answered yet"):
        export_study(study)
    assert not (tmp_path / "export").exists()
    study.close()


class Texts(HTMLParser):
    """The tags of a page, and its texts."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.texts: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        for name, value in attrs:
            assert name in {"alt", "class", "charset", "lang", "src"}
            assert name != "src" or str(value).startswith("data:image/png;base64,")

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def test_names_do_nothing_in_the_report(tmp_path: Path) -> None:
    names = ("<script>alert(1)</script>", r"$\frac{1}$", 'a"onerror="b')
    pool = QueryPool(torch.rand(20, 2, 3), feature_names=names)
    pool.save(tmp_path / "pool.pt")
    typed = f"pool.file={tmp_path / 'pool.pt'}", "study.title='<img src=x> & co'"
    study = study_of(tmp_path, *typed)
    person = study.join("P1")
    assert person is not None
    answer_all(person, lambda person: None if person.n_shown == 2 else 0)
    export_study(study)
    page = Texts()
    page.feed((tmp_path / "export" / "report.html").read_text(encoding="utf-8"))
    assert "script" not in page.tags
    assert "<img src=x> & co" in page.texts
    assert "could not say" in page.texts
    study.close()


@pytest.mark.parametrize(
    "typed",
    [
        ("question=ranking", "pool.options=3"),
        ("question=weak", "setup=feed"),
        ("question=approve", "pool.options=1", "belief=sampled"),
        ("task=lds", "tau=optimal", "belief=sampled", "belief.lapse=0"),
    ],
)
def test_all_kinds(tmp_path: Path, typed: tuple[str, ...]) -> None:
    study = study_of(tmp_path, *typed, "setup.budget=4")
    person = study.join("P1")
    assert person is not None
    answer_all(person, lambda person: 0)
    export_study(study)
    rows = table(tmp_path)
    assert len(rows) == len(person.said) > 0
    assert {row["said"] for row in rows} == {rows[0]["said"]}
    study.close()
