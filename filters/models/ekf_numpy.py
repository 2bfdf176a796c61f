"""Prediction and updates of an EKF of one trajectory in NumPy: PyTorch's calls take several times as long."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor, nn

from beliefscope.filters.belief import Evidence, Gaussian
from beliefscope.filters.models.dynamics import Dynamics
from beliefscope.filters.models.networks import Residual

Layer = tuple[np.ndarray, np.ndarray]
"""Transposed weight, bias."""

_ZERO = np.zeros((), np.float32)


def is_usual(dynamics: nn.Module) -> bool:
    """Whether a dynamics model has the equations below: no static or wrapping components, and no replaced method."""
    usual = type(dynamics) is Dynamics and not dynamics.static and not dynamics.angles.indices
    return usual and "with_jacobian" not in vars(dynamics)


class SingleTrajectory:
    """The equations of ``ExtendedKalmanFilter`` for N = 1 and a common belief of all filters, without gradients.

    The weights are looked up once and share the memory of the parameters.
    """

    def __init__(self, dynamics: Dynamics) -> None:
        self.first, self.output = _layer(dynamics.state_encoder[0]), _layer(dynamics.output)
        self.encoder, self.shared = _residuals(dynamics.state_encoder), _residuals(dynamics.shared)
        self.join = _array(dynamics.join_state.weight).T
        self.identity = np.eye(dynamics.n, dtype=self.join.dtype)
        self.offsets = np.eye(dynamics.n + 1, dynamics.n, dtype=self.join.dtype)  # the last row is zero
        self.noise = _array(dynamics.noise.square()) * self.identity

    @np.errstate(all="ignore")  # as PyTorch
    def predict_and_update(self, belief: Gaussian, evidence: Evidence) -> tuple[Gaussian, Gaussian]:
        """As in ``ExtendedKalmanFilter``; belief: (1, 1, n)."""
        assert evidence.noise is not None
        mean, jacobian = self.with_jacobian(_array(belief.mean)[0, 0], _array(evidence.control)[0])
        covariance = _symmetric(jacobian @ _array(belief.covariance)[0, 0] @ jacobian.T + self.noise)
        z, r = _array(evidence.observation)[0], np.square(_array(evidence.noise)[0])  # (K, n)
        gain = np.linalg.solve(covariance + r[:, :, None] * self.identity, covariance).mT
        means = mean + (gain @ (z - mean)[:, :, None])[:, :, 0]
        covariances = _symmetric(gain * r[:, None])
        if evidence.present is not None:
            present = _array(evidence.present)[0, :, None]
            means = np.where(present, means, mean)
            covariances = np.where(present[:, None], covariances, covariance)
        bank = Gaussian(torch.from_numpy(means[None]), torch.from_numpy(covariances[None]))
        predicted = Gaussian(torch.from_numpy(mean), torch.from_numpy(covariance))
        return Gaussian(predicted.mean.expand_as(bank.mean), predicted.covariance.expand_as(bank.covariance)), bank

    def with_jacobian(self, state: np.ndarray, control_part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As in ``Dynamics``, of one state (n,)."""
        x = state + self.offsets
        hidden = _through(_linear(x, *self.first), self.encoder)
        hidden = _through(_linear(hidden, self.join, control_part), self.shared)
        y = _linear(hidden, *self.output)
        change, gate = y[:, :-1], y[:, -1:]
        scale = 0.5 + 0.5 * np.tanh(0.5 * gate[-1])  # the sigmoid
        moved = x + scale * (change + (gate - gate[-1]) * ((1.0 - scale) * change[-1]))
        return moved[-1], (moved[:-1] - moved[-1]).T


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().numpy()


def _layer(layer: nn.Module) -> Layer:
    assert isinstance(layer, nn.Linear)
    return _array(layer.weight).T, _array(layer.bias)


def _residuals(stack: Iterable[nn.Module]) -> list[tuple[Layer, Layer]]:
    return [(_layer(block.first), _layer(block.second)) for block in stack if isinstance(block, Residual)]


def _linear(x: np.ndarray, weight: np.ndarray, bias: np.ndarray) -> np.ndarray:
    y = x.dot(weight)  # faster than ``@``
    y += bias
    return y


def _rectified(x: np.ndarray) -> np.ndarray:
    """``relu_with_tangents``, in place."""
    x *= np.heaviside(x[-1], _ZERO)  # faster than a mask, which would be converted
    return x


def _through(x: np.ndarray, residuals: list[tuple[Layer, Layer]]) -> np.ndarray:
    """A ReLU and the residual layers after it."""
    x = _rectified(x)
    for first, second in residuals:
        y = _linear(_rectified(_linear(x, *first)), *second)
        y += x
        x = _rectified(y)
    return x


def _symmetric(matrix: np.ndarray) -> np.ndarray:
    return 0.5 * (matrix + matrix.mT)
