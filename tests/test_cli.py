"""The scripts as a user types them."""

from __future__ import annotations

import csv
import json
import os
import re
import runpy
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, ListConfig, OmegaConf
from scripts import run_script

from torchrl_pref.checkpoints.checkpoint import Checkpoint
from torchrl_pref.config.study import ONLY_SIMULATED
from torchrl_pref.pool import QueryPool
from torchrl_pref.pretrained import FOLDER
from torchrl_pref.tasks.gridworld import gridworld_pool
from torchrl_pref.training.progress import Progress

ROOT = Path(__file__).parent.parent

TINY_TASK = ["belief.samples=10", "belief.moves=1", "pool.size=40", "setup.budget=4"]
TINY_TASK += ["evaluation.humans=6", "evaluation.metrics=[]"]
FEW = ["training.sessions=4", "training.steps=8"]
TINY = [*TINY_TASK, *FEW, "training.updates=3"]

SHORT = [*TINY_TASK, *FEW, "training.updates=1", "evaluation.during=0"]
"""For tests that are not about the training itself."""

PARTED = ["training.sessions=128", "training.processes=2"]
"""With two threads (:func:`start`), sessions that two processes ask."""


def start(
    script: str, *arguments: str, cwd: Path = ROOT, **environment: str
) -> subprocess.Popen[str]:
    """A script in a group of processes of its own, as a terminal starts it."""
    return subprocess.Popen(
        [sys.executable, str(ROOT / script), *arguments],
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, **environment},
        # Tests that run in the background of a shell ignore Ctrl-C, which is not what they test.
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.default_int_handler),
    )


def run(script: str, *arguments: str, cwd: Path = ROOT) -> str:
    done = run_script(script, *arguments, folder=cwd)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_train_evaluate_and_resume(tmp_path: Path) -> None:
    """Typed from another folder, with its default run folder."""
    output = run("train.py", "setup=feed", "tau=noisy", *TINY, cwd=tmp_path)
    folder = next((tmp_path / "outputs").glob("*/*"))
    for name in ("checkpoint.pt", "train_pool.pt", "figure_1.png", "figure_2.png", "training.png"):
        assert (folder / name).stat().st_size > 1000
    with (folder / "training.csv").open() as file:
        assert [int(row["update"]) for row in csv.DictReader(file)] == [0, 1, 2, 3]
    assert list((folder / "tensorboard").glob("events*"))
    for row in ("random", "information_gain", "ask all", "RL-feed"):
        assert re.search(rf"^{re.escape(row)} +-?\d\.\d+ +-?\d\.\d+ +-?\d\.\d+", output, re.M)
    assert "noisy human (tau=" in output
    assert "only the critic learns in the first training.warm_up=10 updates" in output

    output = run("evaluate.py", f"checkpoint={folder}", "evaluation.humans=7", cwd=tmp_path)
    assert "RL-feed" in output
    other = gridworld_pool(25, seed=77)
    other.save(tmp_path / "other.pt")
    output = run("evaluate.py", f"checkpoint={folder}", "pool.test=other.pt", cwd=tmp_path)
    assert "RL-feed" in output
    QueryPool(other.features, None, tuple("abcd")).save(tmp_path / "named.pt")
    QueryPool(other.features[:, :1]).save(tmp_path / "one.pt")
    for name, words in (("named", "pool.test has the features a, b, c, d"), ("one", "has K=1")):
        typed = f"checkpoint={folder}", f"pool.test={name}.pt"
        assert words in run_script("evaluate.py", *typed, folder=tmp_path).stderr

    output = run("train.py", f"resume={folder}", "training.updates=5", cwd=tmp_path)
    assert str(folder) in output
    assert Progress.of(Checkpoint.load(folder).training).update == 5
    assert sorted(Progress.of(Checkpoint.load(folder).training).held_out) == [0, 2, 3, 5]
    assert "RL-feed: alignment with 6 held-out humans" in output


def test_humans_who_never_err_are_left_out_where_nobody_asked_for_them(tmp_path: Path) -> None:
    output = run("evaluate.py", "question=weak", *TINY_TASK, f"hydra.run.dir={tmp_path}/run")
    assert output.startswith("note: here tau=noisy alone, because tau=optimal with question=weak")
    assert "optimal human" not in (tmp_path / "run" / "tables.txt").read_text()
    asked_for = run_script("evaluate.py", "question=weak", "tau=[noisy,optimal]", *TINY_TASK)
    assert asked_for.stderr.startswith("error: tau=optimal with question=weak")


def test_resume_is_bit_for_bit(tmp_path: Path) -> None:
    whole, parts = f"hydra.run.dir={tmp_path}/whole", f"hydra.run.dir={tmp_path}/parts"
    run("train.py", "setup=query", *TINY, whole)
    run("train.py", "setup=query", *TINY, "training.updates=1", parts)
    run("train.py", f"resume={tmp_path}/parts", "training.updates=3")
    first, second = (Checkpoint.load(tmp_path / name) for name in ("whole", "parts"))
    for key, value in first.weights.items():
        assert torch.equal(value, second.weights[key])
    tables = [(tmp_path / name / "tables.txt").read_text() for name in ("whole", "parts")]
    untimed = [re.sub(r"\S+$", "", table, flags=re.M) for table in tables]
    assert untimed[0] == untimed[1]


def test_ppo_resumes_bit_for_bit_whatever_logs(tmp_path: Path) -> None:
    whole, parts = f"hydra.run.dir={tmp_path}/whole", f"hydra.run.dir={tmp_path}/parts"
    tiny = ["algorithm=ppo", "setup=query", *TINY, "training.warm_up=1"]
    run("train.py", *tiny, whole)
    run("train.py", *tiny, "training.updates=1", "logger=[]", parts)
    assert not {"training.csv", "tensorboard"} & set(os.listdir(tmp_path / "parts"))
    run("train.py", f"resume={tmp_path}/parts", "training.updates=3", "logger=[csv]")
    first, second = (Checkpoint.load(tmp_path / name) for name in ("whole", "parts"))
    assert first.settings["algorithm"]["name"] == "ppo"
    for key, value in first.weights.items():
        assert torch.equal(value, second.weights[key])
    tables = []
    for name in ("whole", "parts"):
        with (tmp_path / name / "training.csv").open() as file:
            tables.append([{**row, "frames_per_second": ""} for row in csv.DictReader(file)])
    for row in (*tables[0], *tables[1]):  # evaluations are spread over the updates asked for
        for column in [column for column in row if column.startswith("held_out")]:
            del row[column]
    assert tables[0] == tables[1]


@pytest.mark.parametrize("sessions", [FEW, PARTED])
def test_ctrl_c_saves_and_says_how_to_go_on(sessions: list[str], tmp_path: Path) -> None:
    """A terminal sends it to all processes."""
    folder = tmp_path / "run"
    long = ["training.updates=100000", "training.save_every=1"]
    typed = *TINY, *sessions, *long, f"hydra.run.dir={folder}"
    process = start("train.py", *typed, NUMBA_NUM_THREADS="2")
    for _ in range(600):
        if (folder / "checkpoint.pt").exists():
            break
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 130
    assert f"train.py resume={folder}" in output
    state = Checkpoint.load(folder).training
    assert state["update"] > 0
    assert len(state["sessions"].get("others", ())) == (sessions is PARTED)


def test_sweep_makes_one_table(tmp_path: Path) -> None:
    sweep = f"hydra.sweep.dir={tmp_path}/sweep"
    output = run("train.py", "-m", "setup=query,feed", "tau=optimal,0.5", *SHORT, sweep)
    with (tmp_path / "sweep" / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["setup"], row["tau"]) for row in rows] == [
        ("query", "optimal"),
        ("query", "0.5"),
        ("feed", "optimal"),
        ("feed", "0.5"),
    ]
    assert all(-1 <= float(row["alignment after 4"]) <= 1 for row in rows)
    assert "summary.csv" in output
    before = (tmp_path / "sweep" / "summary.csv").read_text()
    run("train.py", f"resume={tmp_path}/sweep/0")
    assert (tmp_path / "sweep" / "summary.csv").read_text() == before
    other = f"hydra.run.dir={tmp_path}/other/0"
    run("train.py", "setup=query", "tau=optimal", "seed=4", *SHORT, other)
    both = f"checkpoint=[{tmp_path}/sweep/0,{tmp_path}/other/0]"
    output = run("evaluate.py", both, f"hydra.run.dir={tmp_path}/both")
    assert "RL (sweep/0)" in output
    assert "RL (other/0)" in output
    output = run("evaluate.py", f"checkpoint={tmp_path}/sweep", f"hydra.run.dir={tmp_path}/all")
    for row in ("optimal human", "noisy human (tau=0.5)", "RL ", "RL-feed"):
        assert row in output
    assert (tmp_path / "all" / "figure_2.png").exists()
    ahead = "strategy=lookahead", f"hydra.run.dir={tmp_path}/ahead"
    assert "lookahead" in run("evaluate.py", f"checkpoint={tmp_path}/other/0", *ahead)
    ahead = "strategy=lookahead", f"hydra.run.dir={tmp_path}/refused"
    refused = run_script("evaluate.py", f"checkpoint={tmp_path}/sweep/2", *ahead, folder=ROOT)
    assert "strategy=lookahead with setup=feed: it is for setup=query alone" in refused.stderr


@pytest.mark.parametrize("setup", ["query", "feed"])
def test_paper_experiment(setup: str, tmp_path: Path) -> None:
    output = run(
        "train.py",
        "experiment=paper",
        f"setup={setup}",
        *TINY,
        "pool.options=3",
        "seed=3",
        f"hydra.run.dir={tmp_path}",
    )
    checkpoint = Checkpoint.load(tmp_path)
    assert checkpoint.settings["policy"]["name"] == "paper"
    assert checkpoint.settings["training"]["optimizer"] == "rmsprop"
    # An index of the training pool means nothing elsewhere: it is evaluated on both.
    assert ("training pool" in output) == (setup == "query")


def test_attention_experiment(tmp_path: Path) -> None:
    run("train.py", "experiment=attention", *TINY, f"hydra.run.dir={tmp_path}")
    settings = Checkpoint.load(tmp_path).settings
    assert (settings["setup"]["name"], settings["policy"]["name"]) == ("query", "attention")
    assert settings["training"]["gamma"] == 0


def test_evaluate_compares_the_baselines(tmp_path: Path) -> None:
    output = run("evaluate.py", *TINY_TASK, f"hydra.run.dir={tmp_path}")
    for row in (
        "optimal human",
        "noisy human",
        "random",
        "information_gain",
        "cosine of mean",
        "repeated",
    ):
        assert row in output
    with (tmp_path / "curves.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["metric"] for row in rows} >= {"alignment", "alignment_of_mean", "information"}
    assert len({row["task"] for row in rows}) == 2
    assert (tmp_path / "records.csv.gz").exists()


@pytest.mark.parametrize("example", sorted((ROOT / "examples").glob("*.py")), ids=lambda p: p.stem)
def test_examples_run(example: Path, tmp_path: Path) -> None:
    assert len(example.read_text().splitlines()) < 50
    typed = {"drive_by_reward": [tmp_path], "pendulum_file": [tmp_path / "trips.csv", 20]}
    assert run(str(example.relative_to(ROOT)), *map(str, typed.get(example.stem, [2])))


def keys_of(config: DictConfig) -> set[str]:
    """Dotted keys of the leaves of a configuration."""
    plain = OmegaConf.to_container(config)
    found: set[str] = set()

    def walk(node: object, prefix: str) -> None:
        if isinstance(node, dict):
            for key, value in node.items():
                walk(value, f"{prefix}.{key}" if prefix else str(key))
        else:
            found.add(prefix)

    walk(plain, "")
    return found


OPTIONS = {
    "train": [
        *("setup=query", "policy=attention", "policy=paper", "algorithm=ppo", "question=weak"),
        *("task=gymnasium", "task=torchrl", "task=files", "task=minari"),
    ],
    "evaluate": ["setup=query", "question=weak", "human=drifting", "human=myopic"],
    "ask": ["setup=query", "question=weak", "belief=laplace", "task=files"],
}


@pytest.mark.parametrize("script", OPTIONS)
def test_help_explains_every_key_and_tells_its_default(script: str) -> None:
    """It is made from the comments in conf: whatever is added there without one fails here."""
    text = run(f"{script}.py", "--help")
    assert len(text.splitlines()) > 50
    assert max(map(len, text.splitlines())) <= 100
    for chosen in ["setup=feed", *OPTIONS[script]]:
        with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
            config = compose(script, [chosen])
        for key in keys_of(config):
            if script == "ask" and key in ONLY_SIMULATED:
                assert key not in text
                continue
            value = OmegaConf.select(config, key)
            if key.endswith(".name"):
                shown = rf"^ *{key.removesuffix('.name')}={value} "
            else:
                plain = str(
                    OmegaConf.to_container(value) if isinstance(value, ListConfig) else value
                )
                plain = {"None": "null", "True": "true", "False": "false"}.get(plain, plain)
                shown = rf"^ *{re.escape(key)}={re.escape(plain.replace(chr(39), ''))}(\n)? +\S"
            assert re.search(shown, text, re.M), key


def test_help_comes_at_once() -> None:
    code = "import sys; sys.argv = ['train.py', '--help']; import runpy; "
    code += "runpy.run_path('train.py', run_name='__main__'); "
    code += "assert not {'torch', 'numba', 'matplotlib'} & set(sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr


PRETRAINED = ROOT / "torchrl_pref" / "policies" / "weights" / "query-noisy-0.pt"

BAD_INPUT = [
    ("train", "setup=nonsense", "Could not find 'setup/nonsense'"),
    ("train", "policy=nonsense", "Could not find 'policy/nonsense'"),
    ("train", "policy=pretraind", "did you mean policy=pretrained?"),
    ("train", "human=myopic pool.train={tmp}/plain.pt pool.test={tmp}/plain.pt", "not a pool of"),
    ("train", "nonsense=1", "Could not override 'nonsense'"),
    ("train", "pool.sise=3", "did you mean pool.size?"),
    ("train", "columns=[a]", "did you mean task.columns?"),
    ("train", "question.threshold=2", "question.threshold belongs to another choice"),
    ("train", "belief.nonsense=1", "Could not override 'belief.nonsense'"),
    ("train", "tau=-1", "tau=-1: expected a finite number above 0"),
    ("train", "tau=0", "tau=0: expected a finite number above 0"),
    ("train", "tau=nan", "tau=nan: expected a finite number above 0"),
    ("train", "tau=loud", "tau='loud': expected noisy, optimal or a number above 0"),
    ("train", "tau=[1,2]", "tau=[1, 2]: expected a finite number above 0"),
    ("train", "belief.samples=1", "belief.samples=1: expected a whole number of at least 8"),
    ("train", "belief.samples=many", "belief.samples='many': expected a whole number"),
    ("train", "pool.options=1", "pool.options=1: expected a whole number of at least 2"),
    ("train", "pool.size=4e1", "pool.size=40.0: expected a whole number, without a point"),
    ("train", "pool.size=0", "pool.size=0: expected a whole number of at least 1"),
    ("train", "setup.budget=0", "setup.budget=0: expected a whole number of at least 1"),
    ("train", "setup.offers=3", "setup.offers=3: expected a whole number of at least"),
    ("train", "setup.on_skip=stay", "setup.on_skip='stay': expected one of new, repeat"),
    ("train", "training.updates=0", "training.updates=0: expected a whole number"),
    ("train", "evaluation.humans=1", "evaluation.humans=1: expected a whole number"),
    ("train", "evaluation.during=-1", "evaluation.during=-1: expected a whole number"),
    ("train", "threads=0", "threads=0: expected a whole number"),
    ("train", "seed=-1", "seed=-1: expected a whole number"),
    ("train", "device=abacus", "device='abacus': expected cpu, cuda"),
    ("train", "device=cuda:99", "device=cuda:99: this machine has"),
    ("train", "resume=nowhere", "nowhere: no such file"),
    ("train", "checkpoint=nowhere", "nowhere: no such file"),
    ("train", "checkpoint={tmp}/text.pt", "cannot be read as a torchrl_pref checkpoint"),
    ("train", "pool.test={tmp}/plain.pt", "expected both pool.train and pool.test"),
    ("train", "pool.train={tmp}/none.pt pool.test={tmp}/wide.pt", "none.pt: no such file"),
    ("train", "pool.train={tmp}/constant.pt pool.test={tmp}/plain.pt", "feature 3 never varies"),
    ("train", "pool.train={tmp}/plain.pt pool.test={tmp}/three.pt", "pool.test has K=3"),
    ("train", "pool.train={tmp}/plain.pt pool.test={tmp}/wide.pt", "D=5: expected D=4"),
    ("train", "hydra.run.dir={tmp}/text.pt/run", "the run folder cannot be written"),
    ("train", "hydra.run.dir=/sys", "cannot be written"),
    ("train", "resume={tmp}/text.pt", "cannot be read as a torchrl_pref checkpoint"),
    ("train", f"resume={PRETRAINED}", "holds a policy without the state of its training"),
    ("train", "objective=fun", "objective='fun': expected one of information_gain, alignment"),
    ("train", "skip=always", "skip='always': expected one of regret, free"),
    ("train", "setup=query policy.start=fun", "policy.start='fun': expected one of"),
    ("train", "policy=attention policy.tokens=all", "policy.tokens='all': expected one of"),
    ("train", "human.spread=0.5", "human.spread=0.5: expected a factor of at least 1"),
    ("train", "training.warm_up=-1", "training.warm_up=-1: expected a whole number"),
    ("train", "task=my_task:Nothing", "my_task.py has no Nothing; expected the name"),
    ("train", "task=nowhere:Table", "no module nowhere in"),
    ("train", "task=my_task:torch", "torch is of type module; expected a function or a class"),
    ("train", "task=own", "expected <module>:<name>"),
    ("train", "human=my_human:Tiring human.patients=3", "unexpected keyword argument 'patients'"),
    ("train", "question=weak question.threshold=-1", "question.threshold=-1: expected a finite"),
    ("train", "question=weak pool.options=3", "a weak question about 3 options: expected 2"),
    ("train", "question=weak tau=optimal", "tau=optimal with question=weak:"),
    ("train", "human=undecided", "human=undecided and question=choice, in which"),
    ("train", "policy.width=3", "width"),
    ("train", "algorithm=dqn", "Could not find 'algorithm/dqn'"),
    ("train", "algorithm.name=ppo", "type algorithm=ppo"),
    ("train", "algorithm=ppo algorithm.epochs=0", "algorithm.epochs=0: expected a whole number"),
    ("train", "algorithm=ppo algorithm.clip_epsilon=2", "algorithm.clip_epsilon=2: expected a"),
    ("train", "+algorithm.epochs=2", "no such key here, with setup=feed and policy=scorer and alg"),
    ("train", "logger=csv", "logger='csv': expected a list, such as logger=[csv,tensorboard]"),
    ("train", "logger=[csv,paper]", "logger='paper': expected one of csv, tensorboard, wandb"),
    ("evaluate", "protocol=all", "protocol='all': expected one of heldout"),
    ("evaluate", "policy=best", "Could not find 'policy/best'"),
    ("evaluate", "policy=scorer", "policy='scorer': expected one of pretrained"),
    ("evaluate", "policy=pretrained checkpoint=x", "name two policies"),
    ("evaluate", "policy=pretrained skip=regret", "expected skip=free; remove skip"),
    ("evaluate", "strategy=mine", "strategy='mine': expected one of random, information_gain"),
    ("evaluate", "strategy=[]", "strategy=[]: expected at least one"),
    ("evaluate", "strategy=no_such_module:rule", "no module no_such_module in"),
    ("evaluate", "strategy=torch:no_such_rule", "has no no_such_rule"),
    ("evaluate", "strategy=torch:pi", "pi is of type float"),
    ("evaluate", "strategy=builtins:repr", "made something of type str"),
    ("evaluate", "strategy=builtins:len protocol=heldout", "making it for a QueryEnv fails"),
    ("train", "+strategy=mine:rule", "strategy='mine:rule': there is no such key here"),
    ("evaluate", "protocol=heldout setup=query", "setup=query: protocol=… brings its own"),
    (
        "evaluate",
        f"protocol=heldout tau=noisy checkpoint={FOLDER / 'query-noisy-0.pt'}",
        "judged by the humans of its training",
    ),
    ("evaluate", "objective=entropy", "objective=… is what a policy is trained for"),
    ("evaluate", "tau=[]", "tau=[]: expected at least one"),
    ("evaluate", "checkpoint=[]", "checkpoint=[]: expected at least one"),
    ("train", "policy=pretrained", "policy='pretrained': expected one of scorer"),
    ("train", "pool.seed=536870912", "pool.seed=536870912: expected a whole number of at most"),
    ("evaluate", "tasks=driver", "tasks=driver without protocol=heldout"),
    ("evaluate", "protocol=heldout tasks=driver task=lds", "remove task, or tasks"),
    ("evaluate", "protocol=heldout tasks=[fun]", "tasks='fun': expected one of gridworld"),
    ("train", "training.problems=drawn policy=paper", "type policy=scorer"),
    (
        "train",
        "training.problems=drawn belief=my_belief:Weighted belief.draws=500",
        "a belief that has no belief.samples",
    ),
    ("train", "training.problems=drawn training.steps=5", "leave training.steps out"),
    ("evaluate", "protocol=heldout workers=0", "workers=0: expected a whole number"),
    (
        "evaluate",
        "protocol=heldout tau=noisy question=weak belief=laplace human=drifting workers=0",
        "workers=0: expected a whole number",
    ),
    ("train", "belief=5", "Config group override must be a string"),
    ("train", "pool=5", "pool is a section of keys"),
    ("train", "setup.name=query", "type setup=query"),
    ("train", "policy.name=paper", "type policy=paper"),
    ("train", "pool.train=5 pool.test=5", "5: no such file"),
    ("train", "checkpoint=5", "5: no such file"),
    ("train", "resume=5", "no such file"),
    ("train", "seed=99999999999999999999", "expected a whole number below"),
    ("evaluate", "checkpoint=0", "checkpoint=0: no such file"),
    ("evaluate", "checkpoint=nowhere", "checkpoint=nowhere: no such file"),
    ("evaluate", "checkpoint={tmp}/text.pt", "cannot be read as a torchrl_pref checkpoint"),
    ("evaluate", "tau=loud", "tau='loud'"),
    ("evaluate", "setup.budget=0", "setup.budget=0: expected a whole number of at least 1"),
    ("ask", "ui=telephone", "ui='telephone': expected one of browser, terminal"),
    ("ask", "participant=../P1", "participant=../P1: expected a code of up to 32 letters"),
    ("ask", "host=1.2.3.4", "host=1.2.3.4 port=0: cannot be served there"),
    ("ask", "port=70000", "port=70000: expected a whole number of at most 65535"),
    ("ask", "strategy=nonsense", "strategy='nonsense': expected one of random, information_gain"),
    ("ask", "strategy=2", "strategy=2: expected a name of docs/strategies.md"),
    ("ask", "strategy=builtins:repr", "strategy makes of an environment of type str"),
    ("ask", "setup=feed strategy=lookahead", "strategy=lookahead with setup=feed"),
    ("ask", "setup.repeats=true", "setup.repeats: people choose from the whole pool"),
    ("ask", "setup.budget=2000", "setup.budget=2000: expected a whole number of at most 1000"),
    ("ask", "pool.size=10", "pool.size=10 with setup.budget=20: expected at least as many"),
    ("ask", "pool.file=nowhere.pt", "nowhere.pt: no such file"),
    ("ask", "question=weak pool.options=3", "3 options"),
    ("ask", "tau=optimal", "tau=optimal"),
    ("ask", "study.attenton=2", "did you mean study.attention?"),
    ("ask", "study.participants=P1,P2", "'study.participants=[P1,P2]'"),
    ("ask", "study.instructions=nowhere.md", "study.instructions=nowhere.md: "),
    ("ask", "study.participants=[P1,P1]", "study.participants"),
    ("ask", "resume=nowhere", "resume=nowhere: "),
    ("ask", "resume={tmp}", "holds no study"),
    ("ask", "export={tmp}", "holds no study"),
    ("ask", "export={tmp} tau=2", "tau"),
    ("ask", "-m tau=1,2", "people answer one study at a time"),
    ("evaluate", "setup=query setup.batch=10 strategy=max_regret", "chooses one query at a time"),
    ("evaluate", "strategy=lookahead", "strategy=lookahead with setup=feed"),
    ("evaluate", "strategy=nonsense protocol=heldout", "strategy='nonsense': expected one of"),
    (
        "evaluate",
        "setup=query pool.train={tmp}/ab.pt pool.test={tmp}/ba.pt",
        "pool.test has the features b, a, c, d, and the training pool a, b, c, d",
    ),
    ("evaluate", "strategy=alignment_gain cost.watch=3", "cost.watch: no strategy here counts"),
    ("ask", "cost.decide=3", "cost.decide: no strategy here counts"),
    ("evaluate", "task=gaussian task.dimension=9999", "expected a whole number from 2 to 1000"),
    ("evaluate", "evaluation.seed=x", "evaluation.seed='x': expected a whole number"),
]


@pytest.mark.parametrize(("script", "typed", "message"), BAD_INPUT, ids=lambda value: str(value))
def test_bad_input_gets_one_line_status_2_and_no_files(
    script: str,
    typed: str,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "text.pt").write_text("not a checkpoint")
    constant = torch.rand(9, 2, 4)
    constant[..., 2] = 3
    QueryPool(torch.rand(9, 2, 4)).save(tmp_path / "plain.pt")
    QueryPool(constant).save(tmp_path / "constant.pt")
    QueryPool(torch.rand(9, 3, 4)).save(tmp_path / "three.pt")
    QueryPool(torch.rand(9, 2, 5)).save(tmp_path / "wide.pt")
    QueryPool(torch.rand(9, 2, 4), None, tuple("abcd")).save(tmp_path / "ab.pt")
    QueryPool(torch.rand(9, 2, 4), None, tuple("bacd")).save(tmp_path / "ba.pt")
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [f"{script}.py", *typed.format(tmp=tmp_path).split()])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")  # set by app.main; put back afterwards
    threads = torch.get_num_threads()
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(ROOT / f"{script}.py"), run_name="__main__")
    GlobalHydra.instance().clear()
    torch.set_num_threads(threads)
    printed = capsys.readouterr()
    assert ended.value.code == 2
    assert printed.err.startswith("error: ")
    assert printed.err.count("\n") == 1
    assert message in printed.err
    assert sorted(tmp_path.rglob("*")) == before


def test_a_run_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "train_pool.pt").write_text("somebody's")
    process = start("train.py", *TINY, f"hydra.run.dir={tmp_path}")
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "holds a run already" in errors
    assert os.listdir(tmp_path) == ["train_pool.pt"]


@pytest.mark.parametrize(
    ("there", "typed", "message"),
    [
        ("study.db", "train.py hydra.run.dir={}", "holds a study of ask.py, and no run"),
        ("study.db", "train.py resume={}", "holds a study of ask.py, and no run"),
        ("study.db", "ask.py hydra.run.dir={}", "go on with it by"),
        ("config.yaml", "ask.py hydra.run.dir={}", "holds a run of train.py"),
        ("tables.txt", "evaluate.py hydra.run.dir={}", "holds an evaluation already"),
    ],
)
def test_what_a_folder_holds_is_named(there: str, typed: str, message: str, tmp_path: Path) -> None:
    for name in ("config.yaml", there):
        (tmp_path / name).write_text("somebody's")
    if there == "tables.txt":
        (tmp_path / "config.yaml").unlink()
    before = sorted(os.listdir(tmp_path))
    done = run_script(*typed.format(tmp_path).split())
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert sorted(os.listdir(tmp_path)) == before


def test_folders_that_the_user_made_are_kept(tmp_path: Path) -> None:
    (tmp_path / "mine" / "run").mkdir(parents=True)
    process = start("train.py", "tau=0", f"hydra.run.dir={tmp_path}/mine/run")
    process.communicate(timeout=60)
    assert process.returncode == 2
    process = start("train.py", "tau=0", cwd=tmp_path / "mine" / "run")
    process.communicate(timeout=60)
    assert process.returncode == 2
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["mine", "run"]


@pytest.fixture(scope="module")
def a_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run, which is to be left as it is."""
    folder = tmp_path_factory.mktemp("run")
    run("train.py", *SHORT, f"hydra.run.dir={folder}")
    return folder


def test_settings_that_a_checkpoint_brings_cannot_be_typed(a_run: Path, tmp_path: Path) -> None:
    shutil.copytree(a_run, tmp_path, dirs_exist_ok=True)
    for script, typed in (("evaluate.py", "checkpoint"), ("train.py", "resume")):
        done = run_script(script, f"{typed}={tmp_path}", "belief.samples=50")
        assert done.returncode == 2
        assert done.stderr.startswith("error: belief.samples=50: ")
        assert "remove belief.samples" in done.stderr
    content = (tmp_path / "checkpoint.pt").read_bytes()
    (tmp_path / "checkpoint.pt").write_bytes(content[: len(content) // 2])
    done = run_script("train.py", f"resume={tmp_path}")
    assert done.returncode == 2
    assert "cut off" in done.stderr
    assert done.stderr.count("\n") == 1


def test_whoever_weighs_steps_is_not_asked_about_an_own_pool(tmp_path: Path) -> None:
    run("train.py", *TINY, "human=myopic", f"hydra.run.dir={tmp_path / 'run'}")
    gridworld_pool(25, seed=77).save(tmp_path / "other.pt")
    named = f"checkpoint={tmp_path / 'run'}", f"pool.test={tmp_path / 'other.pt'}"
    done = run_script("evaluate.py", *named, f"hydra.run.dir={tmp_path / 'tables'}")
    assert done.returncode == 2
    assert done.stderr.startswith("error: human=myopic weighs the steps of trajectories")
    assert done.stderr.count("\n") == 1
    assert not list((tmp_path / "tables").rglob("*"))


def test_summary_is_plain_json(a_run: Path) -> None:
    content = json.loads((a_run / "summary.json").read_text())
    assert set(SHORT) <= set(content["overrides"])
