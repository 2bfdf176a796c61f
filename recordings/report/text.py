"""Methods section of a report: equations of the filter and definitions of the metrics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from beliefscope.datasets.task import Task
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace


@dataclass(frozen=True)
class Passage:
    """A paragraph with inline TeX between dollars, and the displayed equations below it."""

    heading: str
    text: str
    equations: tuple[str, ...] = ()


KALMAN_UPDATE = (
    r"K_k = \bar{S}_k (\bar{S}_k + R_k)^{-1}",
    r"m_k = \bar{m}_k + K_k (z_k - \bar{m}_k) , \quad S_k = (I - K_k) \bar{S}_k",
)
DYNAMICS = r"f(x, u) = x + f_1(x, u) \odot \sigma (f_2(x, u))"


INFORMATION_UPDATE = Passage(
    "Fusion",
    "All filters continue from the fused belief, so they share the prediction $\\bar{m}$, $\\bar{S}$. The fused belief "
    "is its update with all virtual observations at once. A weight model maps all modalities to a weight $\\beta_k$ "
    "per modality and component; the power of an observation is $p_k = K \\beta_k$ for $K$ modalities. Powers multiply "
    "matrices elementwise.",
    (
        r"S^{-1} = \bar{S}^{-1} + \sum_k p_k \odot R_k^{-1}",
        r"m = \bar{m} + S \sum_k p_k \odot R_k^{-1} (z_k - \bar{m})",
    ),
)


PRODUCT_UPDATE = Passage(
    "Update and fusion",
    "A virtual sensor, one network per modality, maps an observation to a measurement $z_k$ of the full state and its "
    "diagonal covariance $R_k$. A slowly varying bias of each sensor is estimated by every particle, with mean "
    "$\\mu_{ik}$ and variance $s_k$ given its path. Particles are weighted by the product of the likelihoods. A weight "
    "model maps all modalities to a weight $\\beta_k$ per modality and component; the power of an observation is "
    "$p_k = K \\beta_k$ for $K$ modalities, which divides $R_k$ elementwise.",
    (r"w_i' \propto w_i \prod_k N(z_k ; \bar{x}_i + \mu_{ik} , s_k + R_k / p_k)",),
)


def methods(trace: Trace, checkpoint: Checkpoint | None) -> list[Passage]:
    """Describe the filter and its evaluation, based on trace and checkpoint."""
    kinds = {"ekf": _kalman, "ukf": _kalman, "pf": _particles, "lstm": _recurrent, "transformer": _attention}
    passages = kinds[trace.kind](trace, checkpoint) if trace.kind in kinds else [_external(trace)]
    return [*passages, _run(trace)]


def _setting(checkpoint: Checkpoint | None, name: str, default: str) -> str:
    """A setting of the architecture; the default without a checkpoint."""
    if checkpoint is None or isinstance(checkpoint, ExternalFilter):
        return default
    return str(getattr(checkpoint.filter.architecture, name))


def _kalman(trace: Trace, checkpoint: Checkpoint | None) -> list[Passage]:
    kalman = "an unscented" if trace.kind == "ukf" else "an extended"
    several = len(trace.modalities) > 1
    names = _listed(trace.modalities)
    if trace.kind == "ukf":
        predicted = (
            r"\bar{m}_k = \sum_i w_i f(\chi_i, u) , \quad "
            r"\bar{S}_k = \sum_i v_i (f(\chi_i, u) - \bar{m}_k) (f(\chi_i, u) - \bar{m}_k)^\top + Q",
        )
        details = "where $\\chi_i$ are the sigma points of the unscented transform and $w_i$, $v_i$ their weights"
    else:
        predicted = (r"\bar{m}_k = f(m_k, u) , \quad \bar{S}_k = A S_k A^\top + Q",)
        details = "where $A$ is the Jacobian of $f$ at $m_k$"
    bank = [
        Passage(
            "Prediction",
            f"Each measurement model ({names}) has {kalman} Kalman filter with mean $m_k$ and covariance $S_k$ of the "
            f"state; all share the learned dynamics $f$ of state $x$ and control $u$ and its diagonal noise $Q$, "
            f"{details}.",
            (DYNAMICS, *predicted),
        ),
        Passage(
            "Update",
            "A virtual sensor, one network per measurement model, maps an observation to a measurement $z_k$ of the "
            "full state and its diagonal covariance $R_k$. The measurement matrix is the identity.",
            KALMAN_UPDATE,
        ),
    ]
    if not several:
        return [*bank, Passage("Fusion", "There is only one measurement model, so no fusion is required.")]
    if trace.weights is None:
        equations: tuple[str, ...] = (r"S = ( \sum_k S_k^{-1} )^{-1} , \quad m = S \sum_k S_k^{-1} m_k",)
        return [*bank, Passage("Fusion", "The beliefs are fused as a product of Gaussians.", equations)]
    if _setting(checkpoint, "fusion", "crossmodal") == "information":
        return [*bank, INFORMATION_UPDATE]
    equations = (r"m = \sum_k \beta_k \odot m_k",)
    if _setting(checkpoint, "covariance", "paper") == "moments":
        covariance = "The covariance is that of the mixture, per pair of components."
        equations += (r"S = \sum_k \sqrt{\beta_k \beta_k^\top} \odot ( S_k + (m_k - m) (m_k - m)^\top )",)
    else:
        covariance = (
            "Division is elementwise. If the result is not positive definite, its correlations are limited until it is."
        )
        equations += (r"S = \frac{\sum_k B_k \odot S_k}{\sum_k B_k} , \quad B_k = \beta_k \beta_k^\top",)
    feedback = {
        "True": " All filters continue from the fused belief.",
        "False": " Each filter continues from its own belief.",
    }.get(_setting(checkpoint, "feedback", ""), "")
    text = (
        "A weight model maps all modalities to a weight $\\beta_k$ per modality and component of the state; weights "
        f"sum to one over the modalities. {covariance}{feedback}"
    )
    return [*bank, Passage("Fusion", text, equations)]


def _particles(trace: Trace, checkpoint: Checkpoint | None) -> list[Passage]:
    count = str(trace.particle_count or "M")
    resampling = _setting(checkpoint, "resampling", "")
    resampled = f" Particles are resampled at every step ({resampling})." if resampling else ""
    passages = [
        Passage(
            "Prediction",
            f"The belief is {count} particles $x_i$ with weights $w_i$. The learned dynamics $f$ of state and control "
            "$u$ move each particle, with Gaussian noise of a learned diagonal covariance $Q$.",
            (DYNAMICS, r"\bar{x}_i = f(x_i, u) + q_i , \quad q_i \sim N(0, Q)"),
        )
    ]
    moments = r"m = \sum_i w_i' \bar{x}_i , \quad S = \sum_i w_i' (\bar{x}_i - m) (\bar{x}_i - m)^\top"
    closing = f" Estimate and covariance are the mean and covariance of the particles before resampling.{resampled}"
    if _setting(checkpoint, "fusion", "crossmodal") == "information":
        return [
            *passages,
            replace(PRODUCT_UPDATE, text=PRODUCT_UPDATE.text + closing, equations=(*PRODUCT_UPDATE.equations, moments)),
        ]
    models = f"A network per measurement model ({_listed(trace.modalities)}) computes the likelihood $p_k(z | x)$ of "
    models += "its observation $z$ at a particle, up to a constant factor."
    raw = _setting(checkpoint, "likelihoods", "raw" if trace.weights is None else "normalised") == "raw"
    scale = "" if raw else " s_k^{-1}"
    weight = r" \beta_k" if trace.weights is not None else ""
    single = len(trace.modalities) == 1
    term = r"p(z | \bar{x}_i)" if single else rf"\sum_k{weight}{scale} p_k(z | \bar{{x}}_i)"
    equations = [rf"w_i' \propto w_i {term}"]
    text = models
    if trace.weights is not None:
        text += " A weight model maps all modalities to weights $\\beta_k$, which sum to one."
    if not single and not raw:
        text += " Each likelihood is divided by its mean $s_k$ over the predicted particles."
        equations.append(r"s_k = \sum_i w_i p_k(z | \bar{x}_i)")
    return [*passages, Passage("Update" if single else "Update and fusion", text + closing, (*equations, moments))]


def _recurrent(trace: Trace, checkpoint: Checkpoint | None) -> list[Passage]:
    text = (
        "The estimate is the output of a recurrent network with hidden state $h$. Its inputs are features $e$ of all "
        "observations $z$ and of the control $u$. It has no covariance and no measurement models."
    )
    return [Passage("Estimator", text, (r"h_t = \text{LSTM}(e(z_t, u_t), h_{t-1}) , \quad m_t = W h_t + b",))]


def _attention(trace: Trace, checkpoint: Checkpoint | None) -> list[Passage]:
    text = (
        "The estimate is the output of a transformer, whose layers attend to the inputs of the last steps. These are "
        "features $e$ of all observations $z$ and of the control $u$. It has no covariance and no measurement models."
    )
    return [Passage("Estimator", text, (r"m_t = f(e(z_t, u_t), e(z_{t-1}, u_{t-1}), \dots)",))]


def _external(trace: Trace) -> Passage:
    return Passage(
        "Filter",
        f"{trace.filter} is an external filter. The report covers the quantities it reported: estimates"
        f"{', covariance' if trace.has_covariance else ''}"
        f"{', particles' if trace.particles is not None else ''}"
        f"{', fusion weights' if trace.weights is not None else ''}"
        f"{', innovations' if trace.innovation is not None else ''}.",
    )


def _run(trace: Trace) -> Passage:
    task = trace.task
    start = "Runs start at the true state"
    if task.start_distance:
        start = "Runs start at an offset from the true state, with a covariance that matches the distance"
    elif not measures.starts_at_truth(trace):
        start = "Runs start at a first belief that the filter or its user sets"
    elif trace.kind == "external":
        known = trace.has_covariance and np.isfinite(trace.start_covariance).all()
        start += f", with the standard deviations {_start_std(trace)}" if known else ""
    elif trace.has_covariance:
        start += ", with covariance 0.1 $I$ in units of the training set's standard deviations"
    excluded = f"exclude the first {task.warmup} steps of each episode, which depend on the start"
    tables = f"Tables {excluded}; curves show all steps." if task.warmup else "Tables and curves show all steps."
    return Passage("Evaluation", f"{start}. {tables} A step is {trace.episode.dt:g} s.")


def _start_std(trace: Trace) -> str:
    """Standard deviations of the first belief, such as ``x 5 cm, heading 2 deg``."""
    units, factors = measures.display_units(trace.task)
    std = factors * np.sqrt(np.diag(trace.start_covariance))
    named = zip(trace.task.components, std, units, strict=True)
    return ", ".join(f"{component.label} {value:z.3g} {unit}".rstrip() for component, value, unit in named)


def definitions(task: Task, trace: Trace) -> list[Passage]:
    """Definitions of the metrics in a report, with $T$ counted steps and $n$ components of the state."""
    angles = any(component.unit == "rad" for component in task.components)
    main = task.main_error
    names = " and ".join(task.components[i].name for i in main.indices)
    meaning = "distance over" if len(main.indices) > 1 else "absolute value in"
    passages = [
        Passage(
            "Error",
            "Estimate minus truth"
            + (", angles wrapped to ±180°." if angles else ".")
            + " RMSE is its root mean square "
            f"over the counted steps of all traces. The {main.name} error is the {meaning} {names}.",
            (r"e_t = m_t - x_t , \quad \text{RMSE} = \sqrt{ \frac{1}{T} \sum_t e_t^2 }",),
        )
    ]
    if trace.has_covariance:
        passages += [
            Passage(
                "NEES/n",
                "Normalised estimation error squared per dimension: 1 on average for a calibrated covariance, larger "
                "for an overconfident one, smaller for an underconfident one.",
                (r"\text{NEES}_t / n = \frac{1}{n} e_t^\top S_t^{-1} e_t",),
            ),
            Passage(
                "95 % coverage",
                "Fraction of steps with the true state inside the 95 % ellipsoid: 95 % for a calibrated covariance.",
                (r"e_t^\top S_t^{-1} e_t \le \chi^2_{n, 0.95}",),
            ),
            Passage(
                "NLL",
                "Mean negative log-likelihood of the true state under the Gaussian estimate, in nats: lower is better.",
                (r"\text{NLL} = \frac{1}{2 T} \sum_t ( e_t^\top S_t^{-1} e_t + \ln | S_t | + n \ln 2 \pi )",),
            ),
        ]
    if trace.log_weights is not None:
        passages.append(
            Passage(
                "Effective sample size",
                "Number of equally weighted particles with the same variance; from the weights before resampling.",
                (r"\text{ESS} = ( \sum_i w_i^2 )^{-1}",),
            )
        )
    if trace.effective_weights is not None:
        passages.append(
            Passage(
                "Effective weight",
                "Share of a modality in the posterior; effective weights sum to one over the modalities.",
            )
        )
    return passages


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names) if names else "none"
