"""An acquisition function of your own, asked greedily: the query that samples are most split about.

    python ../../evaluate.py setup=query strategy=my_acquisition:most_disputed

Each sample of the belief votes for the answer that it thinks likeliest (query by committee: Dagan
and Engelson, 1995). It is a baseline to beat: it counts votes, and not how sure a sample is.
"""

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_pref import QueryEnv
from torchrl_pref.questions.response_model import Prediction
from torchrl_pref.strategies import Greedy


def vote_entropy(predicted: Prediction, samples: Tensor) -> Tensor:
    """Entropy of the votes (… C), in nats, from what M samples predict."""
    votes = torch.nn.functional.one_hot(predicted.probs.argmax(-1), predicted.probs.shape[-1])
    return torch.special.entr(votes.to(samples).mean(-2)).sum(-1)


def most_disputed(env: QueryEnv) -> TensorDictModuleBase:
    """A strategy for an environment."""
    return Greedy(env.belief.response_model, vote_entropy)
