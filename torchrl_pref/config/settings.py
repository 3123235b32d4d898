"""The settings of a run, checked as a whole before anything is made of them.

A table says for each key what its values may be; a section's keys are written with dots, as they
are typed. What can be told from settings alone is told here, in one line and before the heavy
imports: nothing has been made, written or trained by then. What a pool or a checkpoint holds is
looked at by what reads it, and the library's constructors check their own arguments again.

Settings are nested dicts of plain values, as composed by Hydra or read from a checkpoint.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from torchrl_pref.config.checks import (
    COST,
    LARGEST_TAU,
    LARGEST_THREADS,
    Check,
    check_device,
    check_loggers,
    check_path,
    check_spread,
    check_strategy,
    check_tau,
    choice,
    count,
    list_of,
    one_or_more,
    optional,
    positive,
)
from torchrl_pref.config.memory import LEAST_SAMPLES, check_memory
from torchrl_pref.config.sections import Plain, Settings
from torchrl_pref.config.together import (
    check_drawn,
    check_together,
    refuse_batches,
)
from torchrl_pref.errors import (
    InputError,
    check_choice,
    check_flag,
    check_seed,
    check_share,
)

OBJECTIVES = ("information_gain", "alignment", "true_alignment", "entropy")

METRICS = (
    *("alignment", "alignment_of_mean", "accuracy", "log_likelihood", "regret"),
    *("rank_correlation", "calibration"),
)
"""What can be measured of a belief, see ``evaluation.metrics``."""

TASK: dict[str, Check] = {
    "objective": choice(*OBJECTIVES),
    "skip": choice("regret", "free"),
    "device": check_device,
    "threads": count(1, LARGEST_THREADS),
    "pool.size": count(1),
    "pool.options": count(1),
    "pool.seed": count(0, 2**29 - 1),  # a pool takes two seeds below 2**31, and there are two
    "pool.train": optional(check_path),
    "pool.test": optional(check_path),
    "evaluation.humans": count(2),
    "evaluation.seed": check_seed,
    "evaluation.metrics": list_of(*METRICS),
    "human.tau": optional(check_tau),
    "human.lapse": check_share,
    "belief.lapse": check_share,
    "demonstrations.count": count(0),
    "demonstrations.alternatives": count(1),
    "demonstrations.tau": optional(positive(LARGEST_TAU)),
}
"""Of both scripts."""

TRAINING: dict[str, Check] = {
    "tau": check_tau,
    "seed": check_seed,
    "logger": check_loggers,
    "evaluation.during": count(0),
    "training.problems": choice("one", "drawn"),
    "training.updates": count(1),
    "training.sessions": count(1),
    "training.steps": optional(count(1)),
    "training.stages": count(1),
    "training.processes": count(1, LARGEST_THREADS),
    "training.optimizer": choice("adam", "rmsprop"),
    "training.learning_rate": positive(1.0),
    "training.gamma": check_share,
    "training.lmbda": check_share,
    "training.entropy": check_share,
    "training.critic": positive(1e6),
    "training.critic_steps": count(0),
    "training.grad_norm": positive(1e6),
    "training.warm_up": count(0),
    "training.average": check_share,
    "training.save_every": count(1),
}
"""Of a training."""

TRAIN_DOOR: dict[str, Check] = {"resume": optional(check_path), "checkpoint": optional(check_path)}
"""Of train.py, and not of the run that it starts."""

PROTOCOL_TASKS = ("gridworld", "driver", "lds", "gymnasium", "gaussian")
"""Tasks that need no settings of their own."""

EVALUATE: dict[str, Check] = {
    "tau": one_or_more(check_tau),
    "protocol": optional(choice("heldout")),
    "tasks": optional(one_or_more(choice(*PROTOCOL_TASKS))),
    "workers": count(1, LARGEST_THREADS),
    "checkpoint": optional(one_or_more(check_path)),
    "strategy": optional(one_or_more(check_strategy)),
    **COST,
}
"""Of evaluate.py."""

SETUPS: dict[str, dict[str, Check]] = {
    "query": {
        "setup.budget": count(1),
        "setup.candidates": optional(count(1)),
        "setup.repeats": check_flag,
        "setup.batch": count(1),
    },
    "feed": {
        "setup.budget": count(1),
        "setup.offers": optional(count(1)),
        "setup.on_skip": choice("new", "repeat"),
    },
}
POLICIES: dict[str, dict[str, Check]] = {
    "scorer": {"policy.start": optional(choice(*OBJECTIVES)), "policy.sample": check_flag},
    "attention": {
        "policy.tokens": choice("samples", "covariance", "mean"),
        "policy.sample": check_flag,
    },
    "paper": {"policy.sample": check_flag},
}
ALGORITHMS: dict[str, dict[str, Check]] = {
    "a2c": {},
    "ppo": {
        "algorithm.clip_epsilon": positive(1.0),
        "algorithm.epochs": count(1),
        "algorithm.minibatches": count(1),
    },
}
SAMPLED: dict[str, Check] = {
    "belief.samples": count(LEAST_SAMPLES),
    "belief.moves": optional(count(1)),
}
OTHERS: dict[str, dict[str, dict[str, Check]]] = {
    "task": {
        "gridworld": {
            "task.size": count(2, 2**24),  # float32 counts cells no further
            "task.length": count(1),
        }
    },
    "question": {"choice": {}},
    "human": {"simulated": {"human.spread": check_spread}},
    "belief": {
        "sampled": SAMPLED,
        "rationality": {**SAMPLED, "belief.spread": check_spread},
        "laplace": {"belief.samples": count(LEAST_SAMPLES)},
    },
}
"""Of the other groups. What is not in here is checked by what is made of it: ``open_groups``."""

PRETRAINED: dict[str, dict[str, Check]] = {"pretrained": {}}
"""The policies that evaluate.py can be asked for by name."""

Groups = Mapping[str, Mapping[str, Mapping[str, Check]]]
"""By group, and by the name that chooses from it, the checks of its keys."""

OF_TRAINING: Groups = {
    "setup": SETUPS,
    "policy": POLICIES,
    "algorithm": ALGORITHMS,
    **OTHERS,
}

SECTIONS = (
    "pool",
    "demonstrations",
    "evaluation",
    "training",
    "setup",
    "policy",
    "algorithm",
    "study",
    "cost",
    *OTHERS,
)


def check_train_settings(settings: Plain) -> Settings:
    """Refuse what train.py cannot start or go on with.

    Raises:
        InputError: a key is missing, unknown or out of its range, or two do not go together.
    """
    check_keys(settings, TASK | TRAINING | TRAIN_DOOR, OF_TRAINING)
    return check_run(settings)


def check_run(settings: Plain) -> Settings:
    """Refuse the settings of a training, of train.py's or of a checkpoint's.

    Raises:
        InputError: a key is missing, unknown or out of its range, or two do not go together.
    """
    own = {key: value for key, value in settings.items() if key not in (*TRAIN_DOOR, "overrides")}
    check_keys(own, TASK | TRAINING, OF_TRAINING)
    refuse_batches(own, "a policy that is learned")
    check_together(own)
    check_drawn(own)
    checked = cast(Settings, settings)
    check_memory(checked)
    return checked


def check_evaluate_settings(settings: Plain) -> Settings:
    """Refuse what evaluate.py cannot do.

    Raises:
        InputError: a key is missing, unknown or out of its range, or two do not go together.
    """
    groups: Groups = {"setup": SETUPS, **OTHERS}
    if "policy" in settings:
        groups = {**groups, "policy": PRETRAINED}
    check_keys(settings, TASK | EVALUATE, groups)
    if "policy" in settings:
        refuse_batches(settings, "policy=pretrained")
    named = settings["strategy"]
    for name in [named] if isinstance(named, str) else named or []:
        if ":" not in name:
            batches = "what chooses batches is there without being named"
            refuse_batches(settings, f"strategy={name} ({batches})")
    check_together(settings)
    in_feed = "policy" in settings and settings["setup"]["name"] == "feed"
    if in_feed and settings["skip"] != "free":
        raise InputError(
            f"policy=pretrained with skip={settings['skip']}: the pretrained feed policies were "
            "trained with free skips and a budget of asks; expected skip=free; remove skip"
        )
    checked = cast(Settings, settings)
    check_memory(checked)
    return checked


def check_keys(settings: Plain, table: Mapping[str, Check], groups: Groups) -> None:
    """Hold every key to its check, and the keys to the table and to the chosen groups' own.

    Raises:
        InputError: a key is missing, unknown or out of its range.
    """
    for section in SECTIONS:
        if not isinstance(settings.get(section, {}), dict):
            raise InputError(
                f"{section}={settings[section]!r}: {section} is a section of keys and not a value; "
                f"type {section}.<key>=<value>, --help lists them"
            )
    checks = dict(table)
    for group, tables in groups.items():
        checks |= _group_checks(settings, group, tables)
    given = _flat(settings)
    free = tuple(f"{group}." for group in open_groups(settings))
    checks |= {key: _anything for key in given if key.startswith(free) and key not in checks}
    for key in given:
        if key not in checks:
            raise InputError(
                f"{key}={given[key]!r}: there is no such key here, with {_chosen(settings)}; "
                f"remove {key}, or the experiment that sets it; --help lists the keys"
            )
    for key, check in checks.items():
        if key not in given:
            raise InputError(f"{key} is missing: expected a value; leave out what removes {key}")
        check(key, given[key])


def _group_checks(
    settings: Plain, group: str, tables: Mapping[str, Mapping[str, Check]]
) -> dict[str, Check]:
    """The checks of what a group chooses."""
    options = " or ".join(f"{group}={name}" for name in tables)
    if "name" not in settings.get(group, {}):
        raise InputError(f"{group} is missing: expected one; type {options}")
    name = settings[group]["name"]
    if group in open_groups(settings):
        of_all: dict[str, Check] = {"policy.sample": check_flag} if group == "policy" else {}
        return {f"{group}.name": _anything, **of_all}
    check_choice(group, name, tuple(tables))
    return {f"{group}.name": choice(name), **tables[name]}


def open_groups(settings: Plain) -> list[str]:
    """The groups whose settings are checked by what is made of them, and not by a table here."""
    known = {**OTHERS, "policy": {**POLICIES, **PRETRAINED}}
    chosen = {group: settings.get(group, {}).get("name") for group in known}
    return [
        group
        for group, name in chosen.items()
        if name == "own" or (isinstance(name, str) and name not in known[group])
    ]


def _anything(name: str, value: Any) -> None:
    """What is checked elsewhere."""


def _flat(settings: Plain) -> dict[str, Any]:
    """The values by dotted key; what is no section of ours counts as a value."""
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        if key in SECTIONS:
            flat |= {f"{key}.{inner}": each for inner, each in value.items()}
        else:
            flat[key] = value
    return flat


def _chosen(settings: Plain) -> str:
    """The groups that decide which keys there are."""
    groups = {group: settings.get(group, {}).get("name") for group in OF_TRAINING}
    return " and ".join(f"{group}={name}" for group, name in groups.items() if name is not None)
