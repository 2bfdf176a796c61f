"""torchfilter on the vehicle: no adapter class, as its filters already have the interface."""

import numpy as np
import torch
import torchfilter
from vehicle import GPS, SPEED, F, Q

from beliefscope.filters.external.adapter import Adapter

DYNAMICS, PROCESS = (torch.from_numpy(values).float() for values in (F, np.linalg.cholesky(Q)))
NOISE = torch.tensor([GPS, GPS, SPEED])


class Drive(torchfilter.base.DynamicsModel):
    def forward(self, *, initial_states, controls):
        return initial_states @ DYNAMICS.T, PROCESS.expand(len(initial_states), 4, 4)


class Likelihood(torchfilter.base.ParticleFilterMeasurementModel):
    def forward(self, *, states, observations):
        return -0.5 * ((states[..., :3] - observations.unsqueeze(1)) / NOISE).square().sum(-1)


def joined(observations, controls):
    return torch.cat([observations["gps"], observations["speed"]], dim=-1), controls


def particles() -> Adapter:
    models = {"dynamics_model": Drive(state_dim=4), "measurement_model": Likelihood(state_dim=4)}
    filter_ = torchfilter.filters.ParticleFilter(**models, num_particles=500)
    return Adapter(filter_, std=(1.0,) * 4, inputs=joined)
