"""The dynamics model, common to all filters with a prediction step."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from beliefscope.filters.angles import NO_ANGLES, Angles
from beliefscope.filters.models.networks import Residual, Stack, linear, vector_stack


class Dynamics(nn.Module):
    """``x_t = x_{t-1} + f1(x_{t-1}, u_t) * sigmoid(f2(x_{t-1}, u_t))`` plus process noise (Lee et al., sec. V).

    f1 is a vector, f2 a scalar gate, so that direction and size of the change are learned separately. State and control
    pass through three layers each, followed by seven shared layers. The first shared layer is split into two summands,
    so that the controls' part is computed once for all steps. Angles that wrap are read as sine and cosine; the next
    ones are not wrapped, so that they are continuous in the states.

    Attributes:
        static: indices of components that do not change, apart from noise.
    """

    static: tuple[int, ...] = ()

    def __init__(self, n: int, control_size: int, units: int, angles: Angles = NO_ANGLES) -> None:
        super().__init__()
        self.n = n
        self.angles = angles
        self.state_encoder = vector_stack(n + len(angles.indices), units)
        self.control_encoder = vector_stack(control_size, units)
        self.join_state = nn.Linear(units, units, bias=False)
        self.join_control = nn.Linear(units, units)
        self.shared = Stack(nn.ReLU(inplace=True), Residual(units), Residual(units), Residual(units))
        self.output = nn.Linear(units, n + 1)
        self.log_noise = nn.Parameter(torch.empty(n))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initial weights: small changes of the state, and little noise."""
        for module in self.modules():
            if isinstance(module, nn.Linear):
                module.reset_parameters()
        nn.init.normal_(self.output.weight, std=1e-2)
        nn.init.zeros_(self.output.bias)
        nn.init.constant_(self.log_noise, -3.0)

    @property
    def noise(self) -> Tensor:
        """(n,) standard deviation of the process noise, the square root of Q's diagonal."""
        return self.log_noise.clamp(-7.0, 1.0).exp()

    def control_part(self, controls: Tensor) -> Tensor:
        """Controls (..., c) to their part of the first shared layer (..., units)."""
        part: Tensor = self.join_control(self.control_encoder(controls))
        return part

    def forward(self, states: Tensor, control_part: Tensor) -> Tensor:
        """Next states (..., n), without noise; ``control_part`` must broadcast against the states' leading axes."""
        hidden = linear(self.join_state, self.state_encoder(self.angles.features(states))) + control_part
        change, gate = linear(self.output, self.shared(hidden)).split([self.n, 1], dim=-1)
        return states + self._without_static(change) * torch.sigmoid(gate)

    def _without_static(self, change: Tensor) -> Tensor:
        """A change (..., n), or its derivatives, with zeros at static components."""
        if not self.static:
            return change
        return change.index_fill(-1, torch.tensor(self.static, device=change.device), 0.0)

    def with_jacobian(self, states: Tensor, control_part: Tensor) -> tuple[Tensor, Tensor]:
        """Next states (..., n) and the Jacobian A (..., n, n) by the previous state, in one pass."""
        offsets = torch.eye(self.n + 1, self.n, dtype=states.dtype, device=states.device)  # the last row is zero
        x = states + offsets.view(-1, *(1,) * (states.ndim - 1), self.n)
        features = self.angles.features_with_tangents(x)
        hidden = linear(self.join_state, self.state_encoder.with_tangents(features)) + control_part
        y = linear(self.output, self.shared.with_tangents(hidden))
        change, gate = y.split([self.n, 1], dim=-1)
        change, scale = self._without_static(change), torch.sigmoid(gate[-1])
        moved = torch.addcmul(change, change[-1] * (1.0 - scale), gate - gate[-1]).mul(scale).add(x)
        # Row i of the difference is the derivative by state i; A has d(next j)/d(state i) at [j, i].
        return moved[-1], (moved[:-1] - moved[-1]).movedim(0, -1)
