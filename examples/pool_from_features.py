"""Ask about your own trajectories: all you need is a feature tensor (N queries, K options, D)."""

import torch

from torchrl_pref import (
    Belief,
    Boltzmann,
    Normalizer,
    QueryEnv,
    QueryPool,
    SimulatedHuman,
    alignment,
)
from torchrl_pref.strategies import Greedy, RandomQuery

# Say, 300 pairs of grasps described by speed, force and clearance.
features = torch.rand(300, 2, 3, generator=torch.Generator().manual_seed(0))
pool = QueryPool(features)
pool = pool.map_features(Normalizer.fit(pool.features))

model = Boltzmann(tau=3.0)
env = QueryEnv(pool, SimulatedHuman(model), Belief(model), budget=10, batch_size=(50,))
for name, strategy in {"random": RandomQuery(), "greedy": Greedy(model)}.items():
    env.set_seed(0)
    last = env.rollout(10, strategy)[:, -1]
    reached = alignment(last["next", "samples"], last["human", "omega"]).mean()
    print(f"{name}: alignment {reached:.2f} after 10 answers of each of 50 humans")
