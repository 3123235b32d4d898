"""A random sample of ``benchmarks/bad_files.py``, in this process; the whole is run there."""

from __future__ import annotations

import random
import zipfile
from pathlib import Path

import pytest
import torch

from benchmarks import spoil, spoil_contents, spoil_hostile
from benchmarks.bad_files import Bench, all_cases, looks, outcome, placed
from torchrl_pref.checkpoints.checkpoint import Checkpoint
from torchrl_pref.errors import InputError
from torchrl_pref.pool import QueryPool
from torchrl_pref.storage.files import MAX_FILE, _check_pickle
from torchrl_pref.tasks.gridworld import gridworld_pool

OF_EACH_GROUP = 4


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return Bench(tmp_path_factory.mktemp("bench"))


def test_a_sample_of_bad_files_is_refused_or_harmless(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    groups: dict[str, list[spoil.Case]] = {}
    for case in all_cases(bench, 15, seed=1):
        groups.setdefault(case.group, []).append(case)
    rng, found = random.Random(2), {}
    for group, cases in groups.items():
        for number, case in enumerate(rng.sample(cases, OF_EACH_GROUP)):
            folder = tmp_path / group.replace(" ", "-") / str(number)
            folder.mkdir(parents=True)
            monkeypatch.chdir(folder)
            path = placed(case, folder)
            before = looks(path)
            became = outcome(bench, case.door, path)
            mended = became == "harmless" and case.door == "log"
            kept = mended or looks(path) == before
            executed = any(folder.rglob(spoil.MARKER))
            found[group, case.door, case.name] = became, kept, executed
    assert len(found) == OF_EACH_GROUP * len(groups) >= 60
    good = ("refused", True, False), ("harmless", True, False)
    assert {case: what for case, what in found.items() if what not in good} == {}


@pytest.mark.parametrize("name", spoil_contents.EDITS)
def test_a_checkpoint_of_impossible_content_is_refused(
    name: str, bench: Bench, tmp_path: Path
) -> None:
    content = torch.load(bench.files["checkpoint"], weights_only=True)
    edit = spoil_contents.EDITS[name]
    path = spoil_contents.edited(content, "", name, edit).make(tmp_path)
    assert outcome(bench, "checkpoint", path) == "refused"


def test_a_checkpoint_of_impossible_settings_is_refused(bench: Bench, tmp_path: Path) -> None:
    content = torch.load(bench.files["checkpoint"], weights_only=True)
    cases = list(spoil_contents.spoiled_settings(content))
    assert len(cases) > 400
    accepted = [
        case.name
        for case in cases
        if outcome(bench, "checkpoint", case.make(tmp_path)) not in ("refused", "harmless")
    ]
    assert accepted == []


def test_a_pool_of_impossible_content_is_refused(bench: Bench, tmp_path: Path) -> None:
    cases = list(spoil_contents.spoiled_pools())
    assert len(cases) > 20
    for case in cases:
        assert outcome(bench, "pool", case.make(tmp_path)) == "refused", case.name


def test_every_flipped_bit_of_a_small_pool_is_noticed_or_changes_nothing(tmp_path: Path) -> None:
    pool = QueryPool(torch.rand(2, 2, 2))
    pool.save(tmp_path / "pool.pt")
    data = bytearray((tmp_path / "pool.pt").read_bytes())
    rng, lines = random.Random(0), []
    for place in range(0, len(data), 5):
        bit = 1 << rng.randrange(8)
        data[place] ^= bit
        (tmp_path / "flipped.pt").write_bytes(data)
        data[place] ^= bit
        try:
            assert QueryPool.load(tmp_path / "flipped.pt").digest == pool.digest
        except InputError as error:
            lines += ["\n" in str(error)]
    assert len(lines) > 100
    assert not any(lines)


def test_a_flip_in_the_features_is_refused_by_its_checksum(tmp_path: Path) -> None:
    pool = gridworld_pool(20)
    pool.save(tmp_path / "pool.pt")
    data = bytearray((tmp_path / "pool.pt").read_bytes())
    place = data.index(pool.features.numpy().tobytes()) + 40
    data[place] ^= 1
    (tmp_path / "pool.pt").write_bytes(data)
    with pytest.raises(InputError, match="cannot be read as a query pool"):
        QueryPool.load(tmp_path / "pool.pt")


def test_what_is_compressed_or_too_large_is_not_unpacked(tmp_path: Path) -> None:
    gridworld_pool(20).save(tmp_path / "pool.pt")
    with (
        zipfile.ZipFile(tmp_path / "pool.pt") as stored,
        # Level 0 packs nothing: it is refused as what may unpack to anything.
        zipfile.ZipFile(tmp_path / "deflated.pt", "w", 8, compresslevel=0) as deflated,
    ):
        for member in stored.infolist():
            deflated.writestr(member.filename, stored.read(member))
    assert torch.load(tmp_path / "deflated.pt", weights_only=True)["kind"] == "query pool"
    with pytest.raises(InputError, match="cannot be read"):
        QueryPool.load(tmp_path / "deflated.pt")
    with (tmp_path / "large.pt").open("wb") as file:
        file.truncate(MAX_FILE + 1)
    with pytest.raises(InputError, match=r"a file of 4\.0 GiB"):
        QueryPool.load(tmp_path / "large.pt")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (
            spoil_hostile.tensor(spoil_hostile.Storage(torch.FloatStorage, "0", 99), (99,), (1,)),
            "another size",
        ),
        (
            spoil_hostile.tensor(spoil_hostile.Storage(torch.DoubleStorage, "0", 4), (4,), (1,)),
            "another size",
        ),
        (
            spoil_hostile.tensor(spoil_hostile.Storage(torch.FloatStorage, "1", 4), (4,), (1,)),
            "another size",
        ),
        (spoil_hostile.Call(torch.FloatStorage, 10), "used for something else"),
        (spoil_hostile.Call(bytearray, 10), "not what this package writes"),
        ([[] for _ in range(100_000)], "not what this package writes"),
    ],
    ids=["more bytes", "other type", "other part", "storage", "bytes", "too much"],
)
def test_pickles_are_held_to_what_is_in_the_file(value: object, message: str) -> None:
    fine = spoil_hostile.tensor(spoil_hostile.Storage(torch.FloatStorage, "0", 4), (4,), (1,))
    _check_pickle(spoil_hostile.pickled({"kind": "query pool", "features": fine}), {"data/0": 16})
    with pytest.raises(ValueError, match=message):
        _check_pickle(
            spoil_hostile.pickled({"kind": "query pool", "features": value}), {"data/0": 16}
        )


def test_a_file_is_held_to_it(tmp_path: Path) -> None:
    """torch would make the bytes, as many as are asked for, and nobody would look at them."""
    features = torch.rand(3, 2, 2)
    for more, fine in ((5, True), (spoil_hostile.Call(bytearray, 10), False)):
        content = {"kind": "query pool", "features": features, "more": more}
        torch.save(content, tmp_path / "pool.pt")
        assert torch.load(tmp_path / "pool.pt", weights_only=True)
        if fine:
            assert torch.equal(QueryPool.load(tmp_path / "pool.pt").features, features)
        else:
            with pytest.raises(InputError, match="cannot be read"):
                QueryPool.load(tmp_path / "pool.pt")


def test_a_storage_cannot_be_smuggled_past_the_check() -> None:
    """A tuple of one's own from the memo, where the check has just seen a harmless one."""
    harmless = (
        b"(X\x07\x00\x00\x00storagectorch\nFloatStorage\n"
        b"X\x01\x00\x00\x000X\x03\x00\x00\x00cpuK\x04t"
    )
    huge = harmless.replace(b"K\x04t", b"K\xfft")
    assert _check_pickle(b"\x80\x02" + harmless + b"Q.", {"data/0": 16}) is None
    for smuggled in (
        huge + b"Q.",
        huge + b"q\x01" + harmless[:-1] + b"h\x01Q.",
        huge + b"q\x01" + harmless + b"h\x01Q.",
    ):
        with pytest.raises(ValueError, match=r"another (way|size)"):
            _check_pickle(b"\x80\x02" + smuggled, {"data/0": 16})


def test_what_is_no_file_is_named_as_what_it_is(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "folder").mkdir()
    for name, message in (
        ("loop", "cannot be opened"),
        ("folder", "is a folder; expected a query pool, a file"),
        ("nothing", "no such file"),
    ):
        with pytest.raises(InputError, match=message):
            QueryPool.load(tmp_path / name)
        with pytest.raises(InputError, match=r"loop: cannot|no such file"):
            Checkpoint.load(tmp_path / name)
    with pytest.raises(InputError, match="is a device or a pipe"):
        QueryPool.load("/dev/null")
