"""An external filter for the door in plain PyTorch: no camera, no training, only the motion of the hand.

beliefscope evaluate door --filter examples/04_own_filter.py:build --start-offset 3cm,20deg
beliefscope record door --filter examples/04_own_filter.py:build -o own.rrd
beliefscope serve --filter examples/04_own_filter.py:build
"""

import torch
from torch import Tensor, nn

DRIFT = (0.002, 0.002, 0.01)  # m, m, rad per step
ACROSS = 0.2  # m: standard deviation of the constraint, as a pushing hand slides along the bar
MOVING = 0.002  # m per step


class HandOnArc(nn.Module):
    """A Kalman filter over hinge x, hinge y (m) and angle (rad). A hand in contact moves on a circle around the hinge.

    The angle grows by ``(r x dp) / |r|^2`` with r from the hinge to the hand, dp its motion. The hinge lies on the
    perpendicular bisector of the motion: ``u . hinge = u . p`` with ``u = dp / |dp|``.
    """

    task = "door"

    def initialize_beliefs(self, *, mean: Tensor, covariance: Tensor) -> None:
        self.mean, self.covariance = mean, covariance  # (N, 3), (N, 3, 3)

    def forward(self, *, observations: dict[str, Tensor], controls: Tensor) -> tuple[Tensor, Tensor]:
        step = controls[:, 3:5]  # of the hand, in x and y
        middle = observations["effector_position"][:, :2] - step / 2
        length = step.norm(dim=1, keepdim=True)
        holds = observations["contact"] * (length > MOVING)  # (N, 1)

        arm = middle - self.mean[:, :2]
        turn = (arm[:, :1] * step[:, 1:] - arm[:, 1:] * step[:, :1]) / arm.square().sum(1, keepdim=True)
        mean = self.mean + torch.cat([torch.zeros_like(step), holds * turn], dim=1)
        covariance = self.covariance + torch.diag(torch.tensor(DRIFT) ** 2) * holds.unsqueeze(2)

        row = torch.cat([holds * step / length.clamp_min(MOVING), torch.zeros_like(holds)], dim=1)  # (N, 3)
        gain = (covariance @ row.unsqueeze(2)).squeeze(2)
        gain = gain / ((row * gain).sum(1, keepdim=True) + ACROSS**2)
        innovation = (row[:, :2] * (middle - mean[:, :2])).sum(1, keepdim=True)
        self.mean = mean + gain * innovation
        self.covariance = covariance - gain.unsqueeze(2) * (row.unsqueeze(1) @ covariance)
        return self.mean, self.covariance


def build() -> nn.Module:
    return HandOnArc()
