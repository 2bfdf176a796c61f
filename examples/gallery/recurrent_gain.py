"""A recurrent filter that learns its Kalman gain from innovations, in the manner of KalmanNet (Revach et al., 2022).

python examples/gallery/recurrent_gain.py gain.safetensors
beliefscope trace vehicle --data vehicle.h5 --filter examples/gallery/recurrent_gain.py:build --episode 0 -o gain.trace
"""

import os
import sys

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from vehicle import GPS, SPEED, F, drive

SCALE = torch.tensor([GPS, GPS, SPEED])
DYNAMICS = torch.from_numpy(F).float()


class RecurrentGain(nn.Module):
    """Predicts with known dynamics; a GRU maps scaled innovations to the gain (4, 3). Starts at the origin."""

    def __init__(self, width: int = 32) -> None:
        super().__init__()
        self.cell, self.gain = nn.GRUCell(3, width), nn.Linear(width, 12)
        self.initialize_beliefs()

    def initialize_beliefs(self) -> Tensor:
        self.x, self.memory = torch.zeros(1, 4), torch.zeros(1, self.cell.hidden_size)
        return self.x

    def forward(self, *, observations: dict[str, Tensor], controls: Tensor) -> dict[str, Tensor]:
        predicted = self.x.expand(len(controls), 4) @ DYNAMICS.T
        z = torch.cat([observations["gps"], observations["speed"]], dim=1)
        nu = (z - predicted[:, :3]) / SCALE
        nu = nu * torch.cat([observations["fix"], observations["fix"], torch.ones_like(observations["fix"])], dim=1)
        nu = torch.asinh(nu)  # outliers count less
        self.memory = self.cell(nu, self.memory.expand(len(controls), -1))
        gain = 0.1 * self.gain(self.memory).reshape(-1, 4, 3)
        self.x = predicted + (gain @ nu.unsqueeze(-1)).squeeze(-1)
        return {"estimate_mean": self.x, "extra": {"gain": gain.norm(dim=(1, 2))}}


def train(steps: int = 400, episodes: int = 64, length: int = 100) -> RecurrentGain:
    """Minimises the squared position and velocity error over simulated episodes with gaps and outliers."""
    torch.manual_seed(0)
    data = [drive(1000 + i, length, (30, 70) if i % 2 else None, 0.05) for i in range(episodes)]
    keys = ("gps", "fix", "speed")
    inputs = {key: torch.stack([torch.from_numpy(e.observations[key]) for e in data], 1) for key in keys}
    truth = torch.stack([torch.from_numpy(e.states) for e in data], 1)
    filter_ = RecurrentGain()
    optimizer = torch.optim.Adam(filter_.parameters(), 1e-2)
    for _ in range(steps):
        filter_.initialize_beliefs()
        outputs = [
            filter_(observations={key: value[t] for key, value in inputs.items()}, controls=truth[t, :, :1])
            for t in range(length)
        ]
        loss = (torch.stack([output["estimate_mean"] for output in outputs]) - truth).square().mean()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(filter_.parameters(), 1.0)
        optimizer.step()
    return filter_


def build() -> RecurrentGain:
    filter_ = RecurrentGain()
    filter_.load_state_dict(load_file(os.environ.get("GAIN", "gain.safetensors")))
    return filter_


if __name__ == "__main__":
    save_file(train().state_dict(), sys.argv[1])
