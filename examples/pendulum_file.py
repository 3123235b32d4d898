"""Write a file of trajectories to try `task=files` on: pendulums under random pushes.

python examples/pendulum_file.py trips.csv 2000      2000 trajectories of Gymnasium's Pendulum-v1
python train.py task=files task.path=trips.csv
"""

import csv
import sys

import gymnasium
import numpy as np
from tqdm import tqdm

FEATURES = "upright", "speed", "effort", "changes", "side"
STEPS, HELD, SEED = 200, 10, 700_000  # a push is held for ten steps


def features(seed: int) -> list[float]:
    """How upright it was, how fast it turned, how hard it was pushed, how much the pushes changed,
    and whether it turned to one side."""
    luck = np.random.default_rng(seed)
    strength = luck.uniform(0.2, 2.0)  # of this trajectory
    pushes = np.repeat(strength * luck.uniform(-1, 1, STEPS // HELD), HELD)
    env = gymnasium.make("Pendulum-v1")
    seen = [env.reset(seed=seed)[0]]
    seen += [env.step(np.array([push], dtype=np.float32))[0] for push in pushes]
    upright, _, speed = np.array(seen).T
    return [
        upright.mean(),
        abs(speed).mean(),
        (pushes**2).mean(),
        abs(np.diff(pushes)).mean(),
        speed.mean(),
    ]


path, count = sys.argv[1], int(sys.argv[2])
with open(path, "w", newline="") as file:
    writer = csv.writer(file)
    writer.writerow(FEATURES)
    for number in tqdm(range(count), desc="trajectories"):
        writer.writerow(f"{value:.6g}" for value in features(SEED + number))
print(f"{path}: {count} trajectories of {len(FEATURES)} features")
