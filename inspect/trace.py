"""A trace: everything a filter knew at every step of one episode. All that is shown or recorded reads only this."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save
from torch import Tensor

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import WHOLE, Faults
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.filters.batch import Steps
from beliefscope.filters.belief import Evidence, Gaussian, Particles, StepTrace, moments
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import Foreign
from beliefscope.filters.filter import Filter, Kind
from beliefscope.filters.models.pf import ParticleFilter
from beliefscope.filters.models.resampling import effective_sample_size
from beliefscope.filters.rollout import rollout, start_at_truth
from beliefscope.inspect.traces.validate import check_intact

Array = NDArray[np.float32]
FORMAT = 1


@dataclass(frozen=True)
class Trace:
    """T steps, K modalities, n state components, M particles; SI units (m, rad), float32 unless said.

    Index t is step t of the episode. The belief before step 0 is ``start_mean``, ``start_covariance``.
    Fields that a kind of filter does not have are None.

    Attributes:
        episode: what was filtered: truth, contact, observations as the filter saw them, replay.
        modalities: names of the K measurement models, in the order of every K axis: each a modality, or several joined
            by ``+`` that share one. None in an LSTM, which has no models: K is 0.
        kind: ``ekf``, ``ukf``, ``pf``, ``lstm`` or ``foreign``, which has what could be captured. What is said of EKFs
            here holds for UKFs as well.
        filter: its name.
        estimate_mean, estimate_covariance: (T, n), (T, n, n) fused posterior. LSTM: the covariance is NaN.
        modality_mean, modality_covariance: (T, K, n), (T, K, n, n): what each modality alone believes after the step.
            EKF: its own filter's posterior; PF: the predicted particles weighted by its likelihood alone.
        start_mean, start_covariance: (n,), (n, n) belief before the first step.
        weights: (T, K, W) beta as the network gave it; W is n (per component) or 1.
        acting: (T, K, W) share of each modality in the fused result as it acted; sums to one over K. Crossmodal EKF:
            beta over the sum of betas; unimodal EKF, W = n: the diagonal of S S_k^-1, its share of each mean; PF:
            prior weight x beta x likelihood as fused, over that of all, summed over particles. None where K < 2.
        predicted_mean, predicted_covariance: EKF: (T, K, n), (T, K, n, n): before the observation.
        observation_mean, observation_covariance: EKF: (T, K, n), (T, K, n, n): the virtual sensors' z and R.
        particles: PF: (T, M, n) predicted particles.
        prior_log_weights, log_weights: PF: (T, M) before and after the observation, both normalised.
        log_likelihood: PF: (T, K, M), not normalised.
        ancestors: PF: (T, M) int32: the particle each resampled one came from.
        checkpoint_hash, data_hash: SHA-256 of the checkpoint's file and of the episode (``Episode.digest``).
        episode_index: index in its data set. seed: of the filter's randomness and of the faults's.
        faults: how its sensors were broken; ``data_hash`` is of the episode before that.
        settings: JSON values: particles, versions.
    """

    episode: Episode
    modalities: tuple[str, ...]
    kind: str
    filter: str
    estimate_mean: Array
    estimate_covariance: Array
    modality_mean: Array
    modality_covariance: Array
    start_mean: Array
    start_covariance: Array
    weights: Array | None = None
    acting: Array | None = None
    predicted_mean: Array | None = None
    predicted_covariance: Array | None = None
    observation_mean: Array | None = None
    observation_covariance: Array | None = None
    particles: Array | None = None
    prior_log_weights: Array | None = None
    log_weights: Array | None = None
    log_likelihood: Array | None = None
    ancestors: NDArray[np.int32] | None = None
    checkpoint_hash: str = ""
    data_hash: str = ""
    episode_index: int = 0
    seed: int = 0
    faults: Faults = WHOLE
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.estimate_mean)

    @property
    def has_covariance(self) -> bool:
        """Whether the estimates come with a covariance: an LSTM's do not."""
        return not np.isnan(self.estimate_covariance).all() or not len(self)

    @property
    def alone(self) -> tuple[str, ...]:
        """The modalities, where it is known what each alone believes; else none."""
        return () if np.isnan(self.modality_mean).all() else self.modalities

    @property
    def anchors(self) -> Array:
        """(T, n) what likelihood maps and drawings are laid around: the truth; the estimate where it is not known."""
        truth = self.episode.states
        return np.where(np.isnan(truth), self.estimate_mean, truth)

    @property
    def effective_sample_size(self) -> Array | None:
        """(T,) ``1 / sum w_i^2`` of the posterior weights, between 1 and M; None for a filter without particles."""
        return None if self.log_weights is None else effective_sample_size(torch.from_numpy(self.log_weights)).numpy()


ARRAYS = tuple(f.name for f in fields(Trace) if "Array" in str(f.type))
"""Names of the array fields of a trace."""


@torch.no_grad()
def trace(
    checkpoint: Checkpoint,
    episode: Episode,
    episode_index: int = 0,
    seed: int = 0,
    particles: int = 300,
    faults: Faults = WHOLE,
    progress: Callable[[float], None] | None = None,
) -> Trace:
    """Runs a filter over an episode from the true state, covariance 0.1 I (standardised), and keeps everything.

    The estimates are bit-identical to those of the untraced run with the same seed: the same steps are taken, and what
    a step knew is kept instead of dropped.

    Args:
        faults: how the sensors are broken; the trace's episode then holds what the filter was given.
        progress: called with the share done, 0..1.

    Raises:
        BadInput: the episode does not fit the checkpoint's task, the faults does not, or a setting is out of range.
    """
    if isinstance(checkpoint, Foreign):
        from beliefscope.inspect.traces.foreign import trace_foreign  # which builds upon this module

        return trace_foreign(checkpoint, episode, episode_index, seed, faults, progress)
    run = begin(checkpoint, episode, episode_index, seed, particles, faults)
    result = rollout(
        checkpoint.filter, run.evidence, run.start, run.generator(), particles, keep=True, progress=progress
    )
    return assemble(checkpoint, run.episode, run.start, run.evidence, result.steps, **run.given)


@dataclass(frozen=True)
class Run:
    """A run of one of our filters over an episode, before its first step.

    Attributes:
        episode: as the filter is given it. start: its belief before step 0, N = 1. evidence: of all steps.
        given: fields of the trace that say where it comes from.
    """

    episode: Episode
    start: Gaussian
    evidence: Evidence
    given: Mapping[str, Any]

    def generator(self) -> torch.Generator:
        """Of all its random numbers."""
        return torch.Generator().manual_seed(self.given["seed"])


@torch.no_grad()
def begin(
    checkpoint: Checkpoint, episode: Episode, episode_index: int, seed: int, particles: int, faults: Faults
) -> Run:
    """Args and errors: as ``trace``."""
    if particles < 1:
        raise BadInput(f"particles must be at least 1, not {particles}")
    if episode.task != checkpoint.task.name:
        raise BadInput(
            f"filter {checkpoint.name!r} is for task {checkpoint.task.name!r}, the episode is of {episode.task!r}"
        )
    filter_ = checkpoint.filter
    given = {"data_hash": episode.digest(), "episode_index": episode_index, "seed": seed, "faults": faults}
    episode = faults.apply(episode, seed)
    batch = Steps.of(filter_.task, [episode]).episode(0)
    settings = {"particles": particles, "torch": torch.__version__}
    return Run(episode, start_at_truth(filter_, batch), filter_.encode(batch), given | {"settings": settings})


def assemble(
    checkpoint: Checkpoint,
    episode: Episode,
    start: Gaussian,
    evidence: Evidence,
    steps: Sequence[StepTrace],
    **given: Any,
) -> Trace:
    """The trace of T steps with N = 1. given: fields of the trace that say where it comes from."""
    filter_ = checkpoint.filter
    si = filter_.statistics
    arrays = ARRAYS_OF[checkpoint.kind](filter_, steps, evidence)
    arrays |= {
        "estimate_mean": si.state_to_si(torch.cat([s.estimate.mean for s in steps])),
        "estimate_covariance": si.covariance_to_si(torch.cat([s.estimate.covariance for s in steps])),
        "start_mean": si.state_to_si(start.mean[0]),
        "start_covariance": si.covariance_to_si(start.covariance[0]),
    }
    if evidence.log_weights is not None:
        arrays["weights"] = evidence.log_weights[:, 0].exp()
    return Trace(
        episode=episode,
        modalities=filter_.names[: arrays["modality_mean"].shape[1]],
        kind=checkpoint.kind,
        filter=checkpoint.name,
        checkpoint_hash=checkpoint.hash,
        **(given | {name: np.ascontiguousarray(value.numpy()) for name, value in arrays.items()}),
    )


def _stack(filter_: Filter, beliefs: list[Gaussian]) -> tuple[Tensor, Tensor]:
    """Means (T, K, n) and covariances (T, K, n, n) in SI units of T banks with N = 1."""
    si = filter_.statistics
    mean = torch.cat([belief.mean for belief in beliefs])
    return si.state_to_si(mean), si.covariance_to_si(torch.cat([belief.covariance for belief in beliefs]))


def _ekf_arrays(filter_: Filter, steps: Sequence[StepTrace], evidence: Evidence) -> dict[str, Tensor]:
    assert evidence.noise is not None
    predicted = [s.predicted for s in steps if isinstance(s.predicted, Gaussian)]
    modality = [s.modality for s in steps if s.modality is not None]
    arrays: dict[str, Tensor] = {}
    arrays["predicted_mean"], arrays["predicted_covariance"] = _stack(filter_, predicted)
    arrays["modality_mean"], arrays["modality_covariance"] = _stack(filter_, modality)
    z = Gaussian(evidence.observation[:, 0], torch.diag_embed(evidence.noise[:, 0] ** 2))
    arrays["observation_mean"], arrays["observation_covariance"] = _stack(filter_, [z])
    if evidence.log_weights is not None:
        arrays["acting"] = torch.softmax(evidence.log_weights[:, 0], dim=1)
    elif len(filter_.names) > 1:
        information = torch.linalg.inv(torch.cat([belief.covariance for belief in modality]))
        fused = torch.cat([s.estimate.covariance for s in steps])
        arrays["acting"] = (fused.unsqueeze(1) @ information).diagonal(dim1=-2, dim2=-1)
    return arrays


def _pf_arrays(filter_: Filter, steps: Sequence[StepTrace], evidence: Evidence) -> dict[str, Tensor]:
    predicted = [s.predicted for s in steps if isinstance(s.predicted, Particles)]
    states = torch.cat([p.states for p in predicted])
    prior = torch.cat([p.log_weights for p in predicted])
    posterior = torch.cat([s.posterior.log_weights for s in steps if isinstance(s.posterior, Particles)])
    log_likelihood = torch.cat([s.log_likelihood for s in steps if s.log_likelihood is not None])
    alone = torch.log_softmax(prior.unsqueeze(1) + log_likelihood, dim=-1)
    modality = moments(states.unsqueeze(1), alone)
    si = filter_.statistics
    arrays = {
        "particles": si.state_to_si(states),
        "prior_log_weights": prior,
        "log_weights": posterior,
        "log_likelihood": log_likelihood,
        "ancestors": torch.cat([s.ancestors for s in steps if s.ancestors is not None]).int(),
        "modality_mean": si.state_to_si(modality.mean),
        "modality_covariance": si.covariance_to_si(modality.covariance),
    }
    assert isinstance(filter_, ParticleFilter)
    if len(filter_.names) == 1:
        return arrays
    weighed = log_likelihood - filter_.scale(prior, log_likelihood)
    evidence_of_each = torch.logsumexp(prior.unsqueeze(1) + weighed, dim=-1, keepdim=True)
    if evidence.log_weights is not None:
        evidence_of_each = evidence_of_each + evidence.log_weights[:, 0]
    arrays["acting"] = torch.softmax(evidence_of_each, dim=1)
    return arrays


def _lstm_arrays(filter_: Filter, steps: Sequence[StepTrace], evidence: Evidence) -> dict[str, Tensor]:
    none = torch.zeros(len(steps), 0, filter_.n)
    return {"modality_mean": none, "modality_covariance": none.unsqueeze(-1).expand(-1, -1, -1, filter_.n)}


ARRAYS_OF: dict[Kind, Callable[[Filter, Sequence[StepTrace], Evidence], dict[str, Tensor]]] = {
    "ekf": _ekf_arrays,
    "ukf": _ekf_arrays,
    "pf": _pf_arrays,
    "lstm": _lstm_arrays,
}
"""What each kind of filter knew at its steps, as arrays of a trace."""


def save_trace(trace: Trace, path: Path) -> None:
    """Writes a trace atomically as safetensors with a JSON header. Raises BadInput when the folder does not exist."""
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays_of(trace).items()}
    write_atomically(
        path, save(contiguous, metadata={"beliefscope-trace": json.dumps(header_of(trace), sort_keys=True)})
    )


def arrays_of(trace: Trace) -> dict[str, NDArray[Any]]:
    """Every array of a trace by name; those of its episode are under ``episode/``."""
    episode = trace.episode
    arrays: dict[str, NDArray[Any]] = {
        name: getattr(trace, name) for name in ARRAYS if getattr(trace, name) is not None
    }
    arrays |= {f"episode/{name}": getattr(episode, name) for name in ("states", "controls", "contact", "qpos")}
    return arrays | {f"episode/observations/{key}": value for key, value in episode.observations.items()}


def header_of(trace: Trace) -> dict[str, Any]:
    """All of a trace that is not an array, as JSON values."""
    episode = trace.episode
    apart = (*ARRAYS, "episode", "faults", "settings")
    return {
        "format": FORMAT,
        **{f.name: getattr(trace, f.name) for f in fields(Trace) if f.name not in apart},
        "faults": trace.faults.to_json(),
        "settings": dict(trace.settings),
        "episode": {
            "task": episode.task,
            "dt": episode.dt,
            "seed": episode.seed,
            "split": episode.split,
            "provenance": dict(episode.provenance),
        },
    }


def load_trace(path: Path) -> Trace:
    """Reads a trace without loss. Raises BadInput when it is missing, truncated, or not a trace."""
    path = Path(path)
    if not path.is_file():
        raise BadInput(f"trace {str(path)!r} does not exist")
    try:
        with safe_open(path, framework="np") as file:
            metadata = file.metadata() or {}
            arrays = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (not a dict)
        header = read_json(metadata.get("beliefscope-trace", "null"))
    except (SafetensorError, OSError, ValueError, TypeError, AttributeError) as error:
        raise BadInput(f"{str(path)!r} is not a readable trace: {error}") from None
    if not isinstance(header, dict):
        raise BadInput(f"{str(path)!r} is a safetensors file, but not a trace of Beliefscope")
    if (found := header.pop("format", None)) != FORMAT:
        raise BadInput(f"{str(path)!r} has trace format {found!r}; this version reads format {FORMAT}")
    try:
        return trace_of(header, arrays)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise BadInput(f"{str(path)!r} is not a whole trace: {error}") from None


def trace_of(header: Mapping[str, Any], arrays: Mapping[str, Any]) -> Trace:
    """What ``header_of`` and ``arrays_of`` were made of.

    Raises AttributeError, KeyError, TypeError or ValueError, BadInput among them, where that does not fit.
    """
    of_episode: dict[str, Any] = {
        name.removeprefix("episode/"): a for name, a in arrays.items() if name.startswith("episode/")
    }
    prefix = "observations/"
    episode = Episode(
        **header["episode"],
        **{name: of_episode[name] for name in ("states", "controls", "contact", "qpos")},
        observations={n.removeprefix(prefix): a for n, a in of_episode.items() if n.startswith(prefix)},
    )
    said = {name: value for name, value in header.items() if name not in ("format", "episode")}
    said |= {"modalities": tuple(said["modalities"]), "faults": stored_faults(said)}
    said.pop("recipe", None)
    found = Trace(**said, episode=episode, **{n: a for n, a in arrays.items() if not n.startswith("episode/")})
    check_intact(found)
    return found


def stored_faults(header: Mapping[str, Any]) -> Faults:
    """Faults in a stored header, or in an earlier one: key ``recipe``, or a blackout probability in the settings."""
    faults = header.get("faults", header.get("recipe"))
    if faults is None and (blackout := header["settings"].get("blackout")):
        faults = {"blackout": blackout}
    return Faults.of(faults or [])
