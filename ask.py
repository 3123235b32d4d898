"""Ask a person which of two trajectories is better; what they say becomes a reward function.

`python ask.py --help` lists the keys. What takes long to import is imported where it is used, so
that help and refusals come at once.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import hydra
from omegaconf import DictConfig, OmegaConf

import app
import typed
from torchrl_pref import runs
from torchrl_pref.config.sections import Plain
from torchrl_pref.config.study import ONLY_SIMULATED, check_ask_settings
from torchrl_pref.errors import InputError, one_line_errors
from torchrl_pref.storage.writing import write_text

if TYPE_CHECKING:
    from torchrl_pref.study.materials import Materials
    from torchrl_pref.study.study import Study

CONFIG, POOL, LOG = "config.yaml", "pool.pt", runs.STUDY
"""The files of a study; with the log it has begun."""

OF_THE_MACHINE = ("host", "port", "open", "threads")
"""Of each start: a study that was served to others once is not because of that served again."""

BESIDE_RESUME = ("ui", "participant", *OF_THE_MACHINE)
"""What may be typed beside ``resume``: it leaves a study what it is."""


@hydra.main(config_path="conf", config_name="ask", version_base="1.3")
def job(config: DictConfig) -> None:
    """A new study, one to go on with, or what came out of one."""
    with one_line_errors():
        settings = check(typed.plain_settings(config))
        if settings["export"] is not None:
            export(Path(settings["export"]))
        elif settings["resume"] is not None:
            go_on(Path(settings["resume"]), settings)
        else:
            begin(app.output_folder(), settings)


def check(settings: Plain) -> Plain:
    """Refuse what cannot be asked.

    Raises:
        InputError: a setting is out of range, or was typed where something else decides.
    """
    for key in filter(typed.was_typed, ONLY_SIMULATED):
        raise InputError(
            f"{key}: people choose from the whole pool, and are asked nothing twice; remove {key}"
        )
    checked = check_ask_settings(settings)
    own = tuple(key.partition(".")[0] for key in typed.typed_code())
    code = ("strategy",) if ":" in settings["strategy"] else ()
    if settings["export"] is not None:
        typed.refuse_other_overrides("export", ("threads", *code), own)
    elif settings["resume"] is not None:
        typed.refuse_other_overrides("resume", (*BESIDE_RESUME, *code), own)
    typed.refuse_idle_cost([settings["strategy"]])
    app.allow_typed(settings)
    if code and typed.was_typed("strategy"):
        from torchrl_pref.typed_code import allow

        allow(settings["strategy"])
    elif settings["ui"] == "browser":
        check_installed()
    return checked


def check_installed() -> None:
    """Refuse to serve a page without what that takes.

    Raises:
        InputError: it is not installed.
    """
    from importlib.util import find_spec

    missing = [name for name in ("starlette", "uvicorn", "markdown_it") if find_spec(name) is None]
    if missing:
        raise InputError(
            f"ui=browser: {', '.join(missing)} is not installed; install it by make ask, or "
            "pip install -c constraints.txt -e '.[study]', or type ui=terminal"
        )


def begin(folder: Path, settings: Plain) -> None:
    """A new study, in the folder made for it."""
    if (folder / LOG).exists():
        raise InputError(
            f"{folder} holds a study already; go on with it by: "
            f"{app.command(app.as_typed('resume', folder))}, or name another folder by "
            "hydra.run.dir="
        )
    if (folder / CONFIG).exists():
        raise InputError(f"{folder} holds a run of train.py; name another folder by hydra.run.dir=")
    from torchrl_pref.study.materials import check_images, draw_pool, make_materials

    with runs.claimed(folder), way_to_ask(folder, settings) as ask:
        app.use_threads(settings)
        raw = draw_pool(settings)
        if settings["pool"]["file"] is None and len(raw) < settings["pool"]["size"]:
            print(
                f"note: {len(raw)} queries; the task has no more, and "
                f"pool.size={settings['pool']['size']} asks for more"
            )
        materials = make_materials(settings, raw)  # or it is refused, before anything is written
        check_images(materials)
        raw.save(folder / POOL)
        write_text(folder / CONFIG, OmegaConf.to_yaml(OmegaConf.create(settings)))
        run(make_study(folder, materials), ask)


def go_on(folder: Path, typed_now: Plain) -> None:
    """A study that has begun, with its own settings."""
    settings = load_settings("resume", folder)
    settings |= {key: typed_now[key] for key in OF_THE_MACHINE}
    settings |= {key: typed_now[key] for key in BESIDE_RESUME if typed.was_typed(key)}
    if settings["ui"] == "browser":
        check_installed()
    from torchrl_pref.study.materials import check_images

    with runs.claimed(folder), way_to_ask(folder, settings) as ask:
        app.use_threads(settings)
        materials = load_materials(folder, settings)
        check_images(materials)
        run(make_study(folder, materials), ask)


def load_settings(key: str, folder: Path) -> Plain:
    """The settings that a study was begun with.

    Raises:
        InputError: the folder holds no study, or its settings cannot be read.
    """
    if not (folder / LOG).is_file() or not (folder / CONFIG).is_file():
        raise InputError(
            f"{key}={folder}: holds no study, with its {LOG} and {CONFIG}; expected the folder "
            "that ask.py named; check the path"
        )
    try:
        settings = OmegaConf.to_container(OmegaConf.load(folder / CONFIG))
    except Exception as error:  # whatever the reader trips over, the file is at fault
        raise InputError(f"{folder / CONFIG}: cannot be read ({error}); restore it") from error
    if not isinstance(settings, dict):
        raise InputError(f"{folder / CONFIG}: holds no settings; restore it")
    from torchrl_pref.acquisition.per_second import Cost

    plain = {str(name): value for name, value in settings.items()}
    plain.setdefault("cost", asdict(Cost()))  # of a study begun before it was a setting
    return check_ask_settings(plain)


def load_study(folder: Path, settings: Plain) -> Study:
    """A study from its folder."""
    return make_study(folder, load_materials(folder, settings))


def load_materials(folder: Path, settings: Plain) -> Materials:
    """What a study asks about, from its folder."""
    from torchrl_pref.pool import QueryPool
    from torchrl_pref.study.materials import make_materials

    return make_materials(settings, QueryPool.load(folder / POOL))


def make_study(folder: Path, materials: Materials) -> Study:
    """A study, with what is worth knowing of it printed."""
    from torchrl_pref.study.study import Study

    study = Study(folder, materials)
    for note in study.notes:
        print(note)
    return study


@contextmanager
def way_to_ask(folder: Path, settings: Plain) -> Iterator[Callable[[Study], None]]:
    """What asks people, until somebody stops it.

    Raises:
        InputError: nothing can be served at that address, or drawn in this terminal.
    """
    if settings["ui"] == "terminal":
        from torchrl_pref.study.terminal import check_letters, converse

        check_letters()
        yield lambda study: converse(study, settings["participant"])
        return
    from torchrl_pref.study.serve import listening_at, serve

    host = settings["host"]
    with listening_at(folder, host, settings["port"]) as listening:
        yield lambda study: serve(study, listening, host, settings["open"])


def run(study: Study, ask: Callable[[Study], None]) -> None:
    """Let people answer; then say what can be done with that."""
    try:
        ask(study)
    finally:
        study.close()
        answers = counted(sum(len(one.said) for one in study.people.values()), "answer")
        people = counted(len(study.people), "person", "people")
        print(f"{answers} of {people} in {study.folder}")
        print(f"go on:  {app.command(app.as_typed('resume', study.folder))}")
        print(f"export: {app.command(app.as_typed('export', study.folder))}")


def counted(number: int, one: str, many: str | None = None) -> str:
    """A number with what it counts."""
    return f"{number} {one if number == 1 else many or one + 's'}"


def export(folder: Path) -> None:
    """Write what came out of a study."""
    from torchrl_pref.study.export import export_study

    settings = load_settings("export", folder)
    print("one moment …", flush=True)
    app.use_threads(settings)
    study = load_study(folder, settings)  # people may go on answering meanwhile
    try:
        for path in export_study(study):
            print(path)
    finally:
        study.close()


def main() -> None:
    """Run what was typed."""
    with one_line_errors():
        if {"-m", "--multirun"} & set(sys.argv):
            raise InputError("-m: people answer one study at a time; leave -m out")
    app.main(job, check)


if __name__ == "__main__":
    main()
