"""Learn how somebody wants a car to drive, then drive like that.

A simulated person answers 20 questions about pairs of drives. The reward that follows improves the
controls of a car by its gradient, and is left with a picture of before and after in [folder].
"""

import sys
from pathlib import Path

import torch

from torchrl_pref import Boltzmann, Normalizer, Reward, Session, SimulatedHuman
from torchrl_pref.tasks.base import make_pool
from torchrl_pref.tasks.drawing import save_picture
from torchrl_pref.tasks.driver import DriverTask

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
folder.mkdir(parents=True, exist_ok=True)
torch.set_num_threads(1)
task, model = DriverTask(), Boltzmann(tau=4.0)
raw = make_pool(task, n_queries=500, n_options=2, seed=0)
normalizer = Normalizer.fit(raw.features, raw.feature_names)
session = Session(raw.map_features(normalizer), model, normalizer=normalizer)

wanted = torch.tensor([[0.5, -0.5, 0.5, -0.5]])  # in lane, at speed 1, along the road, not close
human, luck = SimulatedHuman(model), torch.Generator().manual_seed(0)
person = human.draw(1, 20, 2, 4, luck).set("omega", wanted)
for turn in range(20):  # for a live person there is python ask.py task=driver
    shown = session.ask().features.unsqueeze(0)
    session.tell(int(human.respond(shown, person, torch.tensor([turn]))))

Reward.of(session).save(folder / "reward.json")
reward = Reward.load(folder / "reward.json")

controls = (2 * torch.rand(20, 10, generator=luck) - 1).requires_grad_()  # of 20 drives
adam, scenes = torch.optim.Adam([controls], lr=0.02), []
for step in range(301):
    drives = task.roll_out(controls)
    mean, deviation = reward.score(task.features(drives))
    if step in (0, 300):
        best = int(mean.argmax()) if step else 0
        truly = normalizer(task.features(drives[best])) @ wanted[0]
        print(f"step {step}: reward {mean[best]:.2f} ± {deviation[best]:.2f}, truly {truly:.2f}")
        scenes.append(task.scene(drives[best].detach()))
    adam.zero_grad()
    (-mean.sum()).backward()
    adam.step()
    controls.data.clamp_(-1, 1)
save_picture(scenes, folder / "drives.png")
