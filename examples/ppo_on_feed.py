"""Train on FeedEnv with a loop of your own: TorchRL's PPO and a perceptron on the belief mean."""

import sys

import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import FlattenObservation, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_pref import (
    Belief,
    Boltzmann,
    FeedEnv,
    Normalizer,
    SimulatedHuman,
    alignment,
    gridworld_pool,
)

UPDATES = int(sys.argv[1]) if len(sys.argv) > 1 else 20
pool = gridworld_pool()
pool = pool.map_features(Normalizer.fit(pool.features))
model = Boltzmann(tau=4.5)
feed = FeedEnv(pool, SimulatedHuman(model), Belief(model), budget=20, batch_size=(32,))
env = TransformedEnv(feed, FlattenObservation(-2, -1, in_keys=["offer"]))

keys = ["mean", "offer"]
logits = TensorDictModule(MLP(12, 2, num_cells=[64]), in_keys=keys, out_keys=["logits"])
categorical = {"distribution_class": torch.distributions.Categorical, "return_log_prob": True}
actor = ProbabilisticActor(logits, in_keys=["logits"], **categorical)
critic = ValueOperator(MLP(12, 1, num_cells=[64]), in_keys=keys)
loss = ClipPPOLoss(actor, critic)
advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic)
optimizer = torch.optim.Adam(loss.parameters(), 1e-3)
frames = {"frames_per_batch": 640, "total_frames": 640 * UPDATES}
for data in Collector(env, actor, auto_register_policy_transforms=False, **frames):
    advantage(data)
    for _ in range(4):
        losses = loss(data.reshape(-1))
        (losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).backward()
        optimizer.step()
        optimizer.zero_grad()
    reached = alignment(data["next", "samples"], data["human", "omega"])
    final = reached[data["next", "done"]].mean()
    print(f"asks {data['action'].float().mean():.0%}, alignment at the end {final:.2f}")
