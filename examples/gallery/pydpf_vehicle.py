"""A particle filter of PyDPF on the vehicle, with an adapter of the package."""

import numpy as np
import pydpf
import torch
from vehicle import GPS, P0, SPEED, F, Q

from beliefscope.filters.external.pydpf_filters import PyDPF


def particles() -> PyDPF:
    rng, zeros = torch.Generator().manual_seed(0), torch.zeros(4)
    roots = [torch.from_numpy(np.linalg.cholesky(values)).float() for values in (Q, P0)]
    model = pydpf.FilteringModel(
        dynamic_model=pydpf.LinearGaussian(torch.from_numpy(F).float(), zeros, roots[0], generator=rng),
        observation_model=pydpf.LinearGaussian(
            torch.eye(3, 4), torch.zeros(3), torch.diag(torch.tensor([GPS, GPS, SPEED])), generator=rng
        ),
        prior_model=pydpf.MultivariateGaussian(zeros, roots[1], generator=rng),
    )
    filter_ = pydpf.ParticleFilter(pydpf.SystematicResampler(generator=rng), model)
    return PyDPF(filter_, lambda observations: torch.cat([observations["gps"], observations["speed"]], -1), 500)
