"""Train the networks of ``tray`` and ``slot`` and store their weights beside the modules.

    python bench/external_faults/train.py tray slot

The data are 300 simulated episodes of 100 steps without faults, 30 of them for validation. The heads of ``tray`` are
trained with the negative log likelihood of the true positions, the likelihoods of ``slot`` to tell the true state from
47 other ones, and the process noise of both with that of the true steps. Prints the NEES of 20 other episodes, with
which the exponents of the likelihoods of ``slot`` were chosen. The seed is 1, and PyTorch runs with one thread.
``tray`` takes 1 min, ``slot`` 2 min. The files have 0.7 MB in all. Large tensors of ``slot`` are in 16 bits; in
``tray`` that changes a diagnosis.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

sys.path.insert(0, str(Path(__file__).parents[1]))

import beliefscope as bs
from external_faults import slot, tray

EPISODES, TRAINED, FIRST_SEED = 300, 270, 100000
TUNING, TUNING_SEED, WARMUP = 20, 200000, 10
BATCH, CANDIDATES = 128, 48
EXPONENTS = (0.12, 0.5)
"""Of the likelihoods of vision and of haptics; chosen of 1, 0.5, 0.25 and 0.12 in an earlier training."""
SPREAD = (0.01, 0.01, 0.15)  # of the candidates of ``slot``: m, m, rad; times 0.08 to 2
LARGE = 1024
"""Tensors of ``slot`` with at least as many values are stored in 16 bits."""


def store(tensors: dict[str, Tensor], path: Path) -> None:
    """Save weights; ``fault.stored`` reads them."""
    save_file({key: tensor.contiguous() for key, tensor in tensors.items()}, path)


def halved(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The same weights, the large ones in 16 bits."""
    return {key: tensor.half() if tensor.numel() >= LARGE else tensor for key, tensor in tensors.items()}


class Data:
    """Steps of simulated episodes: tensors (number of episodes, steps, ...) of the states, controls and sensors."""

    def __init__(self, module: ModuleType, first_seed: int, count: int) -> None:
        episodes: list[bs.Episode] = [module.simulate(first_seed + i) for i in range(count)]
        self.values = {
            "states": torch.tensor(np.stack([e.states for e in episodes])).float(),
            "controls": torch.tensor(np.stack([e.controls for e in episodes])).float(),
        }
        for key in module.TASK.observations:
            values = torch.tensor(np.stack([e.observations[key] for e in episodes]))
            self.values[key] = values if values.dtype == torch.uint8 else values.float()

    def steps(self, key: str, held_out: bool = False) -> Tensor:
        """Values (steps of the episodes for training or validation, ...)."""
        values = self.values[key]
        return (values[TRAINED:] if held_out else values[:TRAINED]).flatten(0, 1)

    def pairs(self) -> tuple[Tensor, Tensor, Tensor]:
        """States (N, D), next states (N, D) and the controls (N, U) between them, of all episodes."""
        states, controls = self.values["states"], self.values["controls"]
        return states[:, :-1].flatten(0, 1), states[:, 1:].flatten(0, 1), controls[:, 1:].flatten(0, 1)


def gaussian(mean: Tensor, log_variance: Tensor, truth: Tensor) -> Tensor:
    """Negative log likelihood without its constant, a scalar."""
    return 0.5 * (((mean - truth) ** 2) / log_variance.exp() + log_variance).sum(-1).mean()


def fit(
    network: nn.Module,
    loss: Callable[[Tensor, bool], Tensor],
    rows: Tensor,
    checked: Tensor,
    epochs: int,
    decay: float,
    without_dropout: int = 0,
    after_epoch: Callable[[int], None] = lambda epoch: None,
) -> None:
    """Train a network with AdamW, and print its loss.

    Args:
        loss: of row indices of the steps for training, or for validation (second argument).
        rows: steps (N,) for training.
        checked: steps for validation.
        without_dropout: number of last epochs in evaluation mode.
    """
    batches = len(rows) // BATCH
    optimizer = torch.optim.AdamW(network.parameters(), 2e-3, weight_decay=decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-3, epochs * batches)
    for epoch in range(epochs):
        network.train(epoch < epochs - without_dropout)
        for chosen in torch.randperm(len(rows)).split(BATCH)[:batches]:
            value = loss(rows[chosen], False)
            optimizer.zero_grad()
            value.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
            optimizer.step()
            schedule.step()
        network.eval()
        after_epoch(epoch)
        with torch.no_grad():
            print(f"{type(network).__name__} {epoch + 1}/{epochs}: validation {loss(checked, True):.3f}", flush=True)


def train_tray() -> None:
    """Heads, and dynamics with its process noise."""
    data, model = Data(tray, FIRST_SEED, EPISODES), tray.Filter()

    def head(network: nn.Module, key: str, epochs: int, decay: float) -> None:
        inputs = {held_out: data.steps(key, held_out) for held_out in (False, True)}
        truth = {held_out: data.steps("states", held_out)[:, :2] for held_out in (False, True)}

        def loss(rows: Tensor, held_out: bool) -> Tensor:
            x = inputs[held_out][rows]
            return gaussian(*network(x.float() / 255 if key == "camera" else x), truth[held_out][rows])

        fit(network, loss, *(torch.arange(len(truth[h])) for h in (False, True)), epochs, decay, without_dropout=3)

    head(model.haptics, "wrench", 25, 1e-4)
    head(model.vision, "camera", 12, 1e-3)
    dynamics = model.dynamics
    optimizer = torch.optim.Adam(dynamics.parameters(), 5e-3)
    x, y, u = data.pairs()
    for epoch in range(40):
        for rows in torch.randperm(len(x)).split(512):
            value = gaussian(dynamics(x[rows], u[rows]), 2 * dynamics.log_std, y[rows])
            optimizer.zero_grad()
            value.backward()
            optimizer.step()
        if epoch == 25:
            optimizer.param_groups[0]["lr"] = 1e-3
    store(model.state_dict(), tray.WEIGHTS)


def candidates(states: Tensor) -> Tensor:
    """The true states (N, 3) and others around a place near them: (N, CANDIDATES, 3), the true ones first."""
    spread = torch.tensor(SPREAD) * torch.exp(torch.empty(len(states), 3).uniform_(np.log(0.08), np.log(2.0)))
    centre = states + torch.randn_like(states) * spread
    others = centre[:, None] + torch.randn(len(states), CANDIDATES - 1, 3) * spread[:, None]
    return torch.cat([states[:, None], others], 1)


def train_slot() -> None:
    """Likelihoods and process noise."""
    data, model = Data(slot, FIRST_SEED, EPISODES), slot.Filter()
    steps = {held_out: {key: data.steps(key, held_out) for key in data.values} for held_out in (False, True)}

    def truth_first(scores: Tensor) -> Tensor:
        return nn.functional.cross_entropy(scores, torch.zeros(len(scores), dtype=torch.long))

    def haptics(rows: Tensor, held_out: bool) -> Tensor:
        s = {key: values[rows] for key, values in steps[held_out].items()}
        return truth_first(model.haptics(s["force"], s["tip"], candidates(s["states"])))

    def vision(rows: Tensor, held_out: bool) -> Tensor:
        s = {key: values[rows] for key, values in steps[held_out].items()}
        return truth_first(model.vision(s["camera"].float() / 255, candidates(s["states"])))

    def keep_first(epoch: int) -> None:
        if epoch == 0:
            store(halved({f"haptics.{key}": value for key, value in model.haptics.state_dict().items()}), slot.OLD)

    touching = [(steps[h]["force"][:, 2].abs() > 0.6).nonzero()[:, 0] for h in (False, True)]
    fit(model.haptics, haptics, *touching, 16, 1e-3, after_epoch=keep_first)
    fit(model.vision, vision, *(torch.arange(len(steps[h]["states"])) for h in (False, True)), 10, 1e-3)
    optimizer = torch.optim.Adam(model.dynamics.parameters(), 5e-3)
    x, y, u = data.pairs()
    for _ in range(12):
        for rows in torch.randperm(len(x)).split(256):
            std = model.dynamics.std(u[rows])
            error = y[rows] - model.dynamics.move(x[rows][:, None], u[rows])[:, 0]
            value = (0.5 * (error / std) ** 2 + std.log()).sum(-1).mean()
            optimizer.zero_grad()
            value.backward()
            optimizer.step()
    model.temper[:] = torch.tensor(EXPONENTS)
    store(halved(model.state_dict()), slot.WEIGHTS)


@torch.no_grad()
def stored_nees(module: ModuleType) -> float:
    """Mean NEES with the stored weights, of the tuning episodes after their first steps."""
    model, data = module.build(), Data(module, TUNING_SEED, TUNING)
    torch.manual_seed(0)
    states, controls = data.values["states"], data.values["controls"]
    start = torch.diag(torch.tensor(module.START) ** 2).expand(len(states), -1, -1)
    model.initialize_beliefs(mean=states[:, 0], covariance=start)
    values = []
    for t in range(states.shape[1]):
        readings = {key: data.values[key][:, t] for key in module.TASK.observations}
        belief = model(observations=readings, controls=controls[:, t])
        error = (belief["estimate_mean"] - states[:, t]).double()
        covariance = belief["estimate_covariance"].double() + 1e-12 * torch.eye(error.shape[-1])
        values.append((error * torch.linalg.solve(covariance, error)).sum(-1))
    return float(torch.stack(values[WARMUP:]).mean())


def main() -> None:
    training, modules = {"tray": train_tray, "slot": train_slot}, {"tray": tray, "slot": slot}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="+", choices=training, metavar="TASK", help="tray or slot")
    options = parser.parse_args()
    torch.set_num_threads(1)
    for task in options.tasks:
        torch.manual_seed(1)
        began = time.perf_counter()
        training[task]()
        value, seconds = stored_nees(modules[task]), time.perf_counter() - began
        print(f"{task}: NEES {value:.2f} of {len(modules[task].START)} states, {seconds:.0f} s", flush=True)


if __name__ == "__main__":
    main()
