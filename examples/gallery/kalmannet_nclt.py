"""KalmanNet4SensorFusion on recordings of the NCLT data set: GPS, wheel speeds and heading of a robot on a campus.

The repository SongJgit/KalmanNet4SensorFusion (Song, Mei, Xu, Fu, Bu: IEEE Signal Processing Letters, 2024) has no
licence, so its code, weights and data are read from a copy whose folder is in PYTHONPATH, without executing pickles.

python examples/gallery/kalmannet_nclt.py test.pt nclt.h5
beliefscope trace nclt --data nclt.h5 --filter examples/gallery/kalmannet_nclt.py:kalmannet --episode 1 -o nclt.trace
"""

import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import torch
from Net.models import FusionKalmanNet
from Net.params import NCLTFusionWheelGPSParams

from beliefscope.datasets.covariate import Covariate
from beliefscope.datasets.episode import Episode, hold
from beliefscope.datasets.store import write_dataset
from beliefscope.datasets.task import Component, Task
from beliefscope.filters.external.adapter import Adapter

METRES = partial(Component, unit="m", display=("m", 1))
TASK = Task(
    name="nclt",
    components=(METRES("north"), METRES("east"), Component("heading", "rad")),
    observations={"gps": (2,), "wheels": (2,), "imu": (2,)},  # m; m/s, left and right; heading rad, its rate rad/s
    modalities={"gps": ("gps",), "wheels": ("wheels",), "imu": ("imu",)},
    control_size=0,
    dt=1.0,
    map_components=("north", "east"),
    map_half_width=50.0,
    positions={"gps": (0, 1)},
    covariates={"fix": Covariate("boolean")},
    masks={"gps": "fix"},
    warmup=0,
)


class Fusion(FusionKalmanNet):
    """KalmanNet, whose state is north, east, their rates, heading and its rate. A missing fix is NaN."""

    def initialize_beliefs(self, *, mean, covariance):
        start = torch.zeros(len(mean), 6, 1)
        start[:, [0, 1, 4], 0] = mean
        self.init_beliefs(start)

    def forward(self, *, observations, controls):
        gps = observations["gps"].masked_fill(observations["gps.present"][:, None] == 0, torch.nan)
        odometry = torch.cat([observations["wheels"], observations["imu"]], dim=1)
        return super().forward(odometry[..., None], gps[..., None])[:, [0, 1, 4], 0]


def kalmannet() -> Adapter:
    net = Fusion(NCLTFusionWheelGPSParams(6, [0, 3], noise_q2=1, noise_r2=1))
    (path,) = Path(sys.modules["Net.models"].__file__).parents[2].glob("weights/kalman560/*.ckpt")
    weights = torch.load(path, map_location="cpu", weights_only=True)["state_dict"]
    net.load_state_dict({name.removeprefix("model."): tensor for name, tensor in weights.items()})
    return Adapter(net, initial_std=(1, 1, 1))


def episodes(path: str) -> Iterator[Episode]:
    """The recordings of a file of the repository's ``data/NCLT/processed``, one step a second."""
    for data in torch.load(path, weights_only=True):
        array = {name: value.numpy() for name, value in data.items() if torch.is_tensor(value)}
        gps, odometry = array["filtered_gps"], array["wheel"]
        fix = ~np.isnan(gps).any(1)
        yield Episode(
            task=TASK,
            states=np.hstack([array["ground_truth"], array["theta_gt"]]),
            observations={"gps": hold(gps, fix), "wheels": odometry[:, :2], "imu": odometry[:, 2:]},
            covariates={"fix": fix.astype(np.float32)},
            split="test",
            provenance={"date": data["data_date"]},
        )


if __name__ == "__main__":
    write_dataset(sys.argv[2], TASK, episodes(sys.argv[1]))
