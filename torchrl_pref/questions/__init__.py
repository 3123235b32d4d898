"""What can be answered, how likely each answer is, and what it says of ω."""

from torchrl_pref.questions.approve import Approve
from torchrl_pref.questions.base import Question
from torchrl_pref.questions.best_worst import BestWorst
from torchrl_pref.questions.choice import Choice
from torchrl_pref.questions.ranking import Ranking
from torchrl_pref.questions.weak import Weak

QUESTIONS: dict[str, type[Question]] = {
    "choice": Choice,
    "weak": Weak,
    "ranking": Ranking,
    "best_worst": BestWorst,
    "approve": Approve,
}
"""The kinds of question by name."""
