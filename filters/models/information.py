"""Extended Kalman filter with one prior for all modalities, calibrated sensors and correlated sensor errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from beliefscope.filters.batch import position_channels
from beliefscope.filters.belief import Belief, Evidence, Gaussian, StepTrace
from beliefscope.filters.filter import Architecture
from beliefscope.filters.models.ekf import ExtendedKalmanFilter, VirtualSensor
from beliefscope.filters.models.fusion import in_one_turn, powers, symmetric, weighted_product
from beliefscope.filters.models.path_circle import FEATURES, MEMORY, circle

CONTACT = "contact"
"""Observation that is 1 in contact, else 0."""

LAGS = (1, 2, 3, 4, 5, 8, 16, 32, 64)
"""Past steps that virtual sensors of vectors see besides the current one: a stretch of the hand's path.

The path along which a hand pulls a door shows its hinge; the last steps show at which side of the hand a puck is.
"""

MAX_NOISE = 1.0
"""Standardised: a reading that is less informative than the distribution of all states is not used."""

TINY = 1e-12
"""Smallest power whose root is computed: the root's derivative at 0 is infinite."""


def recent_steps(values: Tensor, lags: Sequence[int], relative: list[int]) -> Tensor:
    """Each step's readings (T, N, d) with those of past steps: (T, N, (1 + lags) d). Steps before the first repeat it.

    Args:
        relative: channels given relative to the current step.
    """
    time = torch.arange(len(values), device=values.device)
    lag = torch.tensor((0, *lags), device=values.device)
    window = values[(time[:, None] - lag).clamp_min(0)]  # (T, 1 + lags, N, d)
    origin = torch.zeros_like(values)
    origin[..., relative] = values[..., relative]
    return (window - origin.unsqueeze(1)).transpose(1, 2).flatten(2)


class InformationFilter(ExtendedKalmanFilter):
    """Kalman filter of the state and a bias per sensor: ``z_k = x + r_k b_k + v_k``, ``v_k ~ N(0, s_k^2 R_k / p_k)``.

    ``r_k`` is the root of R_k, which the virtual sensor reports. Errors of a camera pose or a puck's radius last for
    many steps. White noise cannot represent them; a bias does: ``b_k' = phi_k b_k + w``, stationary with standard
    deviation ``bias``. The belief between steps is the joint Gaussian of (x, b_1 ... b_K), n (1 + K) components; traces
    contain its x. The powers are ``p_k = K beta_k``; equal weights and biases of zero give the Kalman filter with
    stacked measurements. Process noise increases with the predicted motion.

    Virtual sensors and dynamics are trained by their likelihood and then frozen. A component of z_k whose standard
    deviation exceeds ``MAX_NOISE`` is not used. Sensors of vectors see the steps ``LAGS`` before, and observe the
    object's position relative to the end effector. Of an object with a static position, they observe the offset
    from the centre of the circle on which the hand moved. Static components have identity dynamics.
    """

    history = MEMORY

    def __init__(self, architecture: Architecture) -> None:
        super().__init__(architecture)
        for name in filter(self.sees_past, self.names):
            extra = FEATURES if self.follows_circle(name) else 0
            self.virtual_sensors[name] = VirtualSensor(self.task, name, architecture, 1 + len(LAGS), extra)
        shape = (len(self.names), self.n)
        self.log_scale = nn.Parameter(torch.full(shape, -1.0))
        self.log_bias = nn.Parameter(torch.full(shape, -0.3))
        self.memory = nn.Parameter(torch.full(shape, 3.0))
        self.log_motion = nn.Parameter(torch.zeros(self.n))
        self.dynamics.static = tuple(i for i, component in enumerate(self.task.components) if component.static)

    @property
    def bias(self) -> Tensor:
        """(K, n) stationary standard deviation of each sensor's bias, in units of its noise."""
        return self.log_bias.exp()

    @property
    def phi(self) -> Tensor:
        """(K, n) correlation of a bias with that of the previous step."""
        return torch.sigmoid(self.memory)

    def error_parameters(self) -> list[nn.Parameter]:
        """Sizes and correlations of all errors: scales of each R, biases, and process noise."""
        return [self.log_scale, self.log_bias, self.memory, self.log_motion, self.dynamics.log_noise]

    def sees_past(self, name: str) -> bool:
        return len(self.task.observations[self.task.modalities[name][0]]) == 1

    def sense(self, name: str, observations: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """z and the square root of R's diagonal of one virtual sensor, (T, N, n), standardised.

        Args:
            observations: standardised, of consecutive steps.
        """
        sensor, values = self.virtual_sensors[name], observations[name]
        if not self.sees_past(name):
            return sensor(observations)
        channels = position_channels(self.task, name)
        flat = [channel for pair in channels for channel in pair]
        features = recent_steps(values, LAGS, flat)
        if not channels:
            return sensor({name: features})
        (mean, std), (state_mean, state_std) = (self.statistics.mean_std(key) for key in (name, "state"))
        x_y, on_map = channels[0], list(self.task.map_indices)
        path = values[..., x_y] * std[x_y] + mean[x_y]
        origin = path
        if self.follows_circle(name):
            contact = self.channel(name, CONTACT)
            touched = values[..., contact] * std[contact] + mean[contact] > 0.5
            centre, shape = circle(path, touched, state_mean[on_map])
            features = torch.cat([features, (centre - path) / state_std[on_map], shape], dim=-1)
            origin = torch.clamp(centre, *(state_mean[on_map] + side * state_std[on_map] for side in (-3.0, 3.0)))
        z, noise = sensor({name: features})
        origin = (origin - state_mean[on_map]) / state_std[on_map]
        return z.index_add(-1, torch.tensor(on_map, device=z.device), origin), noise

    def follows_circle(self, name: str) -> bool:
        """Whether a hand in contact moves about a static point, the centre of its path."""
        static = all(self.task.components[i].static for i in self.task.map_indices)
        return static and CONTACT in self.task.modalities[name] and bool(position_channels(self.task, name))

    def channel(self, name: str, key: str) -> int:
        """Position of a scalar observation in a modality's vector."""
        keys = self.task.modalities[name]
        return sum(self.task.observations[k][0] for k in keys[: keys.index(key)])

    def start(self, belief: Gaussian, particles: int, generator: torch.Generator) -> Belief:
        """The joint Gaussian (N, n (1 + K)) of the state and the biases, which are independent of it."""
        variance = self.bias.flatten().square().expand(len(belief.mean), -1)
        mean = torch.cat([belief.mean, torch.zeros_like(variance)], dim=-1)
        return Gaussian(mean, block_diagonal(belief.covariance, torch.diag_embed(variance)))

    def step(self, belief: Belief, evidence: Evidence, generator: torch.Generator) -> tuple[Belief, StepTrace]:
        assert isinstance(belief, Gaussian)
        assert evidence.log_weights is not None
        predicted = self.predict_joint(belief, evidence.control)
        roots = self.inverse_noise(evidence)  # (N, K, n)
        alone = roots.unsqueeze(1) * torch.eye(len(self.names), device=roots.device).unsqueeze(-1)
        power = powers(evidence.log_weights, evidence.present)
        weighted = roots * power.clamp_min(TINY).sqrt() * (power > 0)
        sensors, observation = self.sensor_matrix(evidence), evidence.observation
        if self.angles.indices:
            expected = (sensors @ predicted.mean.unsqueeze(-1)).reshape_as(observation)
            observation = self.angles.near(observation, expected)
        posteriors = joint_update(
            Gaussian(predicted.mean.unsqueeze(1), predicted.covariance.unsqueeze(1)),
            observation.flatten(1).unsqueeze(1),
            sensors.unsqueeze(1),
            torch.cat([weighted.unsqueeze(1), alone], dim=1).flatten(2),
        )  # of all sensors, and of each alone: (N, 1 + K, n (1 + K))
        states = self.state_of(posteriors)
        estimate = Gaussian(states.mean[:, 0], states.covariance[:, 0])
        bank = Gaussian(states.mean[:, 1:], states.covariance[:, 1:])
        trace = StepTrace(self.bank_of(self.state_of(predicted)), posterior=estimate, estimate=estimate, modality=bank)
        return self.wrapped(Gaussian(posteriors.mean[:, 0], posteriors.covariance[:, 0])), trace

    def state_of(self, joint: Gaussian) -> Gaussian:
        """The state's marginal (..., n) of a joint Gaussian (..., n (1 + K))."""
        return self.wrapped(Gaussian(joint.mean[..., : self.n], joint.covariance[..., : self.n, : self.n]))

    def inverse_noise(self, evidence: Evidence) -> Tensor:
        """(N, K, n) inverse standard deviations of v_k; zero where a reading is not used."""
        assert evidence.noise is not None
        used = evidence.noise < MAX_NOISE
        if evidence.present is not None:
            used = used & evidence.present.unsqueeze(-1)
        return used / (evidence.noise * self.log_scale.exp())

    def sensor_matrix(self, evidence: Evidence) -> Tensor:
        """H (N, K n, n (1 + K)): each sensor observes the state plus its own bias, in units of its noise."""
        assert evidence.noise is not None
        state = torch.eye(self.n, dtype=evidence.noise.dtype, device=evidence.noise.device)
        state = state.repeat(len(self.names), 1).expand(len(evidence), -1, -1)
        return torch.cat([state, torch.diag_embed(evidence.noise.flatten(1))], dim=-1)

    def predict_joint(self, belief: Gaussian, control: Tensor) -> Gaussian:
        """Prediction of state and biases. control: (N, u), the controls' part of the dynamics model."""
        phi, state = self.phi.flatten(), belief.mean[:, : self.n]
        mean, jacobian = self.dynamics.with_jacobian(state, control)
        transition = block_diagonal(jacobian, torch.diag(phi).expand(len(mean), -1, -1))
        bias = self.bias.flatten().square() * (1.0 - phi.square())
        noise = torch.cat([self.process_noise(mean - state).square(), bias.expand(len(mean), -1)], dim=-1)
        covariance = transition @ belief.covariance @ transition.mT + torch.diag_embed(noise)
        return Gaussian(torch.cat([mean, phi * belief.mean[:, self.n :]], dim=-1), symmetric(covariance))

    def process_noise(self, change: Tensor) -> Tensor:
        """Root of Q's diagonal (..., n) for a predicted change (..., n): ``q^2 + m^2 |change|^2``; m = 0 if static."""
        moving = torch.tensor([not component.static for component in self.task.components], device=change.device)
        motion = moving * self.log_motion.exp().square() * change.square().sum(-1, keepdim=True)
        return (self.dynamics.noise.square() + motion).sqrt()

    def virtual_observations(self, evidence: Evidence) -> Gaussian:
        """z and the covariance of its whole error, bias and noise, (T, N, K, n)."""
        assert evidence.noise is not None
        variance = evidence.noise.square() * (self.log_scale.exp().square() + self.bias.square())
        return Gaussian(evidence.observation, torch.diag_embed(variance))

    def fuse(self, bank: Gaussian, log_weights: Tensor | None, present: Tensor | None = None) -> Gaussian:
        """The product of a bank (N, K, n), without a prior."""
        assert log_weights is not None
        return weighted_product(in_one_turn(bank, self.angles), powers(log_weights, present))

    def shares(self, evidence: Evidence) -> Tensor:
        """Information share: beta times the precision of each virtual observation, sum 1 over K, (T, N, K, n)."""
        assert evidence.log_weights is not None
        variance = self.virtual_observations(evidence).covariance.diagonal(dim1=-2, dim2=-1)
        return torch.softmax(evidence.log_weights - variance.log(), dim=-2)


def joint_update(prior: Gaussian, z: Tensor, h: Tensor, root: Tensor) -> Gaussian:
    """Kalman update with ``z = H s + v``, where ``D v`` has unit variance; zeros in D leave out an observation.

    ``S = I + D H P H^T D``, ``K = P H^T D S^-1 D``; covariance in Joseph form.

    Args:
        prior: (..., s). z: (..., m). h: (..., m, s). root: (..., m) D, the inverse standard deviations of v.
    """
    root = root.unsqueeze(-1)
    observed = root * h
    cross = observed @ prior.covariance
    inner = cross @ observed.mT + torch.eye(h.shape[-2], dtype=h.dtype, device=h.device)
    gain = torch.linalg.solve(inner, cross).mT
    innovation = root * z.unsqueeze(-1) - observed @ prior.mean.unsqueeze(-1)
    keep = torch.eye(h.shape[-1], dtype=h.dtype, device=h.device) - gain @ observed
    covariance = keep @ prior.covariance @ keep.mT + gain @ gain.mT
    return Gaussian(prior.mean + (gain @ innovation).squeeze(-1), symmetric(covariance))


def block_diagonal(first: Tensor, second: Tensor) -> Tensor:
    """(..., a, a) and (..., b, b) to (..., a + b, a + b)."""
    a, b = first.shape[-1], second.shape[-1]
    return torch.cat([nn.functional.pad(first, (0, b)), nn.functional.pad(second, (a, 0))], dim=-2)
