"""Baselines: the first alarm of ``beliefscope inspect``, and two classifiers of the statistics of the profile."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from beliefbench.cases import Case, healthy_profile, load_case, read_truth
from beliefbench.scorecard import Answer, component
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnosis.checks.episode_statistics import episode_statistics
from beliefscope.inspect.diagnosis.checks.sensors import sensor_statistics
from beliefscope.inspect.diagnostics.healthy_comparison import Deviation, compare
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.batch import trace_all

HEALTHY = "healthy"
NEIGHBOURS = 3
LIMIT = 10.0
"""Largest deviation of a feature, standard deviations between healthy trajectories."""


def traces_of(case: Case) -> list[Trace]:
    return list(trace_all(case.checkpoint, case.episodes, case.episodes, case.seed, case.particles))


def answer_of(causes: Mapping[str, float]) -> dict[str, Any]:
    """Answer with these causes and probabilities; healthy if that is the most probable."""
    order = sorted(causes, key=lambda cause: -causes[cause])
    if not order or order[0] == HEALTHY:
        return {"state": "healthy", "masked": False, "causes": []}
    named = [cause for cause in order if cause != HEALTHY]
    rows = [{"cause": c, "component": component(c), "probability": causes[c]} for c in named]
    return {"state": "fault", "masked": False, "causes": rows}


def first_alarm(case: Case) -> Answer:
    """The largest alarm of the first diagnostic with any, in the order in which ``inspect`` prints them."""
    traces = traces_of(case)
    profile = HealthyProfile.from_json(case.checkpoint.healthy_profile)
    for entry in DIAGNOSTICS.values():
        if entry.statistics is None or entry.refusal(traces[0], None) is not None:
            continue
        alarms = compare(profile, [entry.statistics(trace) for trace in traces]).alarms
        if alarms:
            return answer_of({cause_of_alarm(alarms[0]): 1.0})
    return answer_of({})


def cause_of_alarm(alarm: Deviation) -> str:
    """The cause that a reader of one alarm would name."""
    kind, subject, _ = alarm.statistic.split("/")
    modality = next((name for name in ("image", "haptics") if subject.startswith(name)), "")
    high = alarm.value > alarm.healthy
    match kind:
        case "nees" if modality:
            return f"model.{modality}.{'overconfident' if high else 'underconfident'}"
        case "nees":
            return "covariance.small" if high else "covariance.large"
        case "nis":
            return "process_noise.small" if high else "process_noise.large"
        case "autocorrelation":
            return "dynamics.bias"
        case "beta" | "weight":
            return f"weights.ignores_{modality if not high else {'image': 'haptics'}.get(modality, 'image')}"
        case "regret":
            return "weights.inverted"
        case _:
            return "particles.deprived"


def features(folder: Path) -> dict[str, float]:
    """``deviations`` of a case, kept in its folder until the healthy profile changes."""
    truth = read_truth(folder)
    profile = json.dumps(healthy_profile(truth["task"], truth["filter"]), sort_keys=True)
    path = folder / f"features-{hashlib.sha256(profile.encode()).hexdigest()[:12]}.json"
    if not path.exists():
        path.write_text(json.dumps(deviations(load_case(folder))))
    return json.loads(path.read_text())


def deviations(case: Case) -> dict[str, float]:
    """``KIND/MODALITY/PHASE`` -> mean deviation from the healthy profile, in its standard deviations.

    State components are averaged, so that features of different tasks agree.
    """
    profile = HealthyProfile.from_json(case.checkpoint.healthy_profile)
    rows = [
        episode_statistics(
            trace,
            case.checkpoint,
            sensor_statistics(trace.episode, profile.reference, profile.readings),
            profile.readings,
        )
        for trace in traces_of(case)
    ]
    groups: dict[str, list[float]] = {}
    for name, healthy in profile.statistics.items():
        values = np.array([row.get(name, np.nan) for row in rows])
        if np.isfinite(values).any() and np.isfinite(healthy).sum() >= 10:
            z = (np.nanmean(values) - np.nanmean(healthy)) / max(float(np.nanstd(healthy)), 1e-6)
            kind, subject, phase = name.split("/")
            key = f"{kind}/{subject.split(' ')[0] if subject.startswith(('image', 'haptics')) else ''}/{phase}"
            groups.setdefault(key, []).append(float(np.clip(z, -LIMIT, LIMIT)))
    return {key: float(np.mean(values)) for key, values in groups.items()}


@dataclass(frozen=True)
class Learned:
    """A classifier that was fitted to tuning cases. names: of the features. matrix: (C, F). causes: C labels."""

    names: list[str]
    matrix: np.ndarray
    causes: list[str]

    @classmethod
    def fit(cls, folders: Sequence[Path]) -> Learned:
        """Clean controls and single causes; pairs are not used."""
        rows, causes = [], []
        for folder in folders:
            planted = read_truth(folder)["planted"]
            if len(planted) < 2:
                rows.append(features(folder))
                causes.append(planted[0]["cause"] if planted else HEALTHY)
        names = sorted({name for row in rows for name in row})
        return cls(names, np.array([_vector(row, names) for row in rows]), causes)

    def nearest_neighbour(self, case: Case) -> Answer:
        """Causes of the ``NEIGHBOURS`` nearest cases, each with the weight 1 / (1 + distance)."""
        distance = np.linalg.norm(self.matrix - _vector(features(case.folder), self.names), axis=1)
        votes: dict[str, float] = {}
        for i in np.argsort(distance, kind="stable")[:NEIGHBOURS]:
            votes[self.causes[i]] = votes.get(self.causes[i], 0.0) + 1.0 / (1.0 + float(distance[i]))
        total = sum(votes.values())
        return answer_of({cause: vote / total for cause, vote in votes.items()})

    def decision_tree(self, case: Case) -> Answer:
        from sklearn.tree import DecisionTreeClassifier  # takes a second

        tree = DecisionTreeClassifier(min_samples_leaf=2, random_state=0).fit(self.matrix, self.causes)
        share = tree.predict_proba(_vector(features(case.folder), self.names)[None])[0]
        return answer_of({str(c): float(p) for c, p in zip(tree.classes_, share, strict=True) if p > 0})


def _vector(row: Mapping[str, float], names: Sequence[str]) -> np.ndarray:
    """Values by name; 0, a healthy one, where the filter has no such statistic."""
    return np.array([row.get(name, 0.0) for name in names])
