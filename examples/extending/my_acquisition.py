"""An acquisition function of your own, asked greedily: the query whose answer is least certain.

    python ../../evaluate.py strategy=my_acquisition:least_certain

It is a baseline to beat: a query may be uncertain because its options are nearly alike, of which
nothing is learned.
"""

from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_pref import QueryEnv
from torchrl_pref.questions.response_model import Prediction
from torchrl_pref.strategies import Greedy


def least_confidence(predicted: Prediction, samples: Tensor) -> Tensor:
    """One less the probability of the likeliest answer (… C), from what M samples predict."""
    return 1 - predicted.probs.mean(-2).amax(-1)


def least_certain(env: QueryEnv) -> TensorDictModuleBase:
    """A strategy for an environment."""
    return Greedy(env.belief.response_model, least_confidence)
