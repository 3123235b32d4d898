"""What a study asks about, and by what: made of its settings.

Shapes: N queries, K options per query, D features.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import cast

from tqdm import tqdm

from torchrl_pref.acquisition.per_second import Cost
from torchrl_pref.beliefs.base import BeliefBase
from torchrl_pref.config.sections import Plain
from torchrl_pref.errors import InputError
from torchrl_pref.groups import make
from torchrl_pref.pool import Normalizer, QueryPool
from torchrl_pref.problem import solve_tau
from torchrl_pref.questions.base import Question
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import model_of
from torchrl_pref.session import Session
from torchrl_pref.strategies import MakeStrategy, make_strategy
from torchrl_pref.tasks.base import Task, feature_bars, make_pool
from torchrl_pref.tasks.images import Images
from torchrl_pref.tasks.scene import Picture, Scene
from torchrl_pref.typed_code import load_typed


@dataclass(frozen=True)
class Materials:
    """What a study asks about, and by what.

    Attributes:
        settings: as typed.
        raw: the queries, not normalised.
        pool: the same, normalised.
        normalizer: by what.
        question: what can be answered.
        response_model: how people are thought to answer.
        strategy: what chooses the questions.
        task: draws trajectories; None where the pool has none.
    """

    settings: Plain
    raw: QueryPool
    pool: QueryPool
    normalizer: Normalizer
    question: Question
    response_model: ResponseModel
    strategy: str | MakeStrategy
    task: Task | None

    @property
    def n_questions(self) -> int:
        """How many a person is shown at most, checks among them."""
        checks = self.settings["study"]
        budget: int = self.settings["setup"]["budget"]
        return budget + checks["attention"] + checks["repeats"]

    @property
    def task_name(self) -> str:
        """What the questions are about; ``own`` where the pool is a file of the user."""
        return "own" if self.task is None else str(self.settings["task"]["name"])

    def session(self, seed: int, people: int | None = None) -> Session:
        """A session of one person, from the start; or of so many side by side."""
        setup = self.settings["setup"]
        return Session(
            self.pool,
            self.response_model,
            self.strategy,
            self._belief(),
            budget=setup["budget"],
            people=people,
            normalizer=self.normalizer,
            seed=seed,
            setup=setup["name"],
            offers=setup.get("offers"),
        )

    def _belief(self) -> BeliefBase:
        section = self.settings["belief"]
        made: BeliefBase = make("belief", section, self.response_model, without=("lapse",))
        return made

    def scene(self, query: int, option: int) -> Scene:
        """What a person is shown of an option of the pool."""
        if self.task is None or self.raw.trajectories is None:
            own = self.raw.features[query, option]
            sizes = self.pool.features[query, option].clamp(-3, 3)
            return feature_bars(self.raw.feature_names, own, sizes)
        return self.task.scene(self.raw.trajectories[query, option])


def draw_pool(settings: Plain) -> QueryPool:
    """The queries of a new study, not normalised: of its file, or drawn from its task.

    Raises:
        InputError: they cannot be had.
    """
    pool = settings["pool"]
    if pool["file"] is not None:
        return QueryPool.load(pool["file"])
    return make_pool(make("task", settings["task"]), pool["size"], pool["options"], pool["seed"])


def make_materials(settings: Plain, raw: QueryPool) -> Materials:
    """Everything that a study needs, from its settings and its queries.

    Raises:
        InputError: a setting cannot be used.
    """
    normalizer = Normalizer.fit(raw.features, raw.feature_names)
    pool = raw.map_features(normalizer)
    question: Question = make("question", settings["question"])
    tau = solve_tau(settings["tau"], pool)
    model = model_of(tau, question, settings["belief"]["lapse"])
    model.n_answers(pool.n_options)  # or it is refused here
    task = None if settings["pool"]["file"] is not None else make("task", settings["task"])
    made = Materials(settings, raw, pool, normalizer, question, model, _strategy(settings), task)
    if task is not None:
        _try_scene(made)
    made.session(0)  # or it is refused here
    return made


def _strategy(settings: Plain) -> str | MakeStrategy:
    """What chooses the questions: by name, with seconds as typed, or as code of the user's."""
    named: str = settings["strategy"]
    if ":" in named:
        return cast(MakeStrategy, load_typed("strategy", named))
    if named == "policy":
        return named
    cost = Cost(**settings["cost"])
    return lambda env: make_strategy(named, env, "policy", cost=cost)


def _try_scene(materials: Materials) -> None:
    """Refuse a task that cannot draw.

    Raises:
        InputError: it cannot.
    """
    scene = materials.scene(0, 0)
    if not isinstance(scene, Scene) or not scene.frames:
        raise InputError(
            f"task={materials.settings['task']['name']}: draws nothing of a trajectory; expected a "
            "Scene with at least one frame from its method scene"
        )


def check_images(materials: Materials) -> None:
    """Refuse to ask about an image that cannot be seen.

    Raises:
        InputError: there is one.
    """
    if not any(isinstance(shape, Picture) for shape in materials.scene(0, 0).shapes):
        return  # as the others of the pool
    options = product(range(len(materials.raw)), range(materials.raw.n_options))
    shapes = (shape for option in options for shape in materials.scene(*option).shapes)
    images, shown = Images(), (shape for shape in shapes if isinstance(shape, Picture))
    for picture in tqdm(dict.fromkeys(shown), desc="images", delay=1, leave=False):
        images.at(picture, 0)
