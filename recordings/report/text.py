"""What a report says of methods: the equations of the filter that made the traces, and what its numbers mean."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from beliefscope.datasets.task import Task
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.evaluate import LEFT_OUT
from beliefscope.filters.external.load import Foreign
from beliefscope.inspect.trace import Trace


@dataclass(frozen=True)
class Passage:
    """Sentences, ``$...$`` being mathematics within them, and the equations that stand below."""

    heading: str
    text: str
    equations: tuple[str, ...] = ()


KALMAN_UPDATE = (
    r"K_k = \bar{S}_k (\bar{S}_k + R_k)^{-1}",
    r"m_k = \bar{m}_k + K_k (z_k - \bar{m}_k) , \quad S_k = (I - K_k) \bar{S}_k",
)
DYNAMICS = r"f(x, u) = x + f_1(x, u) \odot \sigma (f_2(x, u))"


def methods(trace: Trace, checkpoint: Checkpoint | None) -> list[Passage]:
    """How this filter works, as far as trace and checkpoint tell, and how it was run."""
    kinds = {"ekf": _kalman, "ukf": _kalman, "pf": _particles, "lstm": _recurrent}
    own = kinds[trace.kind](trace, checkpoint) if trace.kind in kinds else [_foreign(trace)]
    return [*own, _run(trace)]


def _setting(checkpoint: Checkpoint | None, name: str, default: str) -> str:
    """Of the architecture; the default where the checkpoint is not there to be asked."""
    if checkpoint is None or isinstance(checkpoint, Foreign):
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
        how = "where $\\chi_i$ are the sigma points of the scaled unscented transform and $w_i$, $v_i$ their weights"
    else:
        predicted = (r"\bar{m}_k = f(m_k, u) , \quad \bar{S}_k = A S_k A^\top + Q",)
        how = "where $A$ is the Jacobian of $f$ at $m_k$"
    bank = [
        Passage(
            "Prediction",
            f"Each measurement model ({names}) has {kalman} Kalman filter with mean $m_k$ and covariance $S_k$ of the "
            f"state; all share the learned dynamics $f$ of state $x$ and control $u$ and its diagonal noise $Q$, "
            f"{how}.",
            (DYNAMICS, *predicted),
        ),
        Passage(
            "Update",
            "A virtual sensor, a network of the model's own, makes of an observation a measurement $z_k$ of the whole "
            "state and its diagonal covariance $R_k$. The measurement matrix is the identity.",
            KALMAN_UPDATE,
        ),
    ]
    if not several:
        return [*bank, Passage("Fusion", "There is one measurement model, so its belief is the filter's.")]
    if trace.weights is None:
        equations: tuple[str, ...] = (r"S = ( \sum_k S_k^{-1} )^{-1} , \quad m = S \sum_k S_k^{-1} m_k",)
        return [*bank, Passage("Fusion", "The beliefs are fused as a product of Gaussians.", equations)]
    equations = (r"m = \sum_k \beta_k \odot m_k",)
    if _setting(checkpoint, "covariance", "paper") == "moments":
        said = "The covariance is that of the mixture, per pair of components."
        equations += (r"S = \sum_k \sqrt{\beta_k \beta_k^\top} \odot ( S_k + (m_k - m) (m_k - m)^\top )",)
    else:
        said = (
            "Division is elementwise, and where the result is not positive definite its correlations are limited until "
            "it is."
        )
        equations += (r"S = \frac{\sum_k B_k \odot S_k}{\sum_k B_k} , \quad B_k = \beta_k \beta_k^\top",)
    back = _setting(checkpoint, "feedback", "")
    loop = {
        "True": " Every filter goes on from the fused belief.",
        "False": " Each filter goes on from its own belief.",
    }
    text = (
        "A weight model sees all modalities and gives each a weight $\\beta_k$ for every component of the state, which "
        f"sum to one over the modalities. {said}{loop.get(back, '')}"
    )
    return [*bank, Passage("Fusion", text, equations)]


def _particles(trace: Trace, checkpoint: Checkpoint | None) -> list[Passage]:
    count = "M" if trace.particles is None else str(trace.particles.shape[1])
    resampling = _setting(checkpoint, "resampling", "")
    resampled = f" Particles are resampled at every step ({resampling})." if resampling else ""
    passages = [
        Passage(
            "Prediction",
            f"The belief is {count} particles $x_i$ with weights $w_i$. The learned dynamics $f$ of state and control "
            "$u$ move each, with Gaussian noise of a learned diagonal covariance $Q$.",
            (DYNAMICS, r"\bar{x}_i = f(x_i, u) + q_i , \quad q_i \sim N(0, Q)"),
        )
    ]
    models = f"A network for each measurement model ({_listed(trace.modalities)}) gives the likelihood $p_k(z | x)$ of "
    models += "its observation $z$ at a particle, up to a constant factor."
    raw = _setting(checkpoint, "likelihoods", "raw" if trace.weights is None else "normalised") == "raw"
    scale = "" if raw else " s_k^{-1}"
    weigh = r" \beta_k" if trace.weights is not None else ""
    one = len(trace.modalities) == 1
    term = r"p(z | \bar{x}_i)" if one else rf"\sum_k{weigh}{scale} p_k(z | \bar{{x}}_i)"
    equations = [rf"w_i' \propto w_i {term}"]
    text = models
    if trace.weights is not None:
        text += " A weight model sees all modalities and gives each a weight $\\beta_k$, which sum to one."
    if not one and not raw:
        text += " Each likelihood is divided by its mean $s_k$ over the predicted particles."
        equations.append(r"s_k = \sum_i w_i p_k(z | \bar{x}_i)")
    equations.append(r"m = \sum_i w_i' \bar{x}_i , \quad S = \sum_i w_i' (\bar{x}_i - m) (\bar{x}_i - m)^\top")
    text += f" Estimate and covariance are the moments of the particles before they are resampled.{resampled}"
    return [*passages, Passage("Update" if one else "Update and fusion", text, tuple(equations))]


def _recurrent(trace: Trace, checkpoint: Checkpoint | None) -> list[Passage]:
    text = (
        "The estimate is read out of a recurrent network with hidden state $h$ that is given features $e$ of all "
        "observations $z$ and of the control $u$. It states no covariance, and has no measurement model of a modality."
    )
    return [Passage("Estimator", text, (r"h_t = \text{LSTM}(e(z_t, u_t), h_{t-1}) , \quad m_t = W h_t + b",))]


def _foreign(trace: Trace) -> Passage:
    return Passage(
        "Filter",
        f"{trace.filter} is a filter from outside. What is shown is what could be read of it as it ran: its estimates"
        f"{', their covariance' if trace.has_covariance else ''}"
        f"{', its particles' if trace.particles is not None else ''}"
        f"{', its fusion weights' if trace.weights is not None else ''}.",
    )


def _run(trace: Trace) -> Passage:
    return Passage(
        "Evaluation",
        "Every run starts at the true state"
        + (
            ", with covariance 0.1 $I$ in units of the training set's standard deviations"
            if trace.has_covariance
            else ""
        )
        + f". The first {LEFT_OUT} steps of an episode do not count in any table, because the start still helps there; "
        f"curves show all steps. A step is {trace.episode.dt:g} s.",
    )


def definitions(task: Task, trace: Trace) -> list[Passage]:
    """What the numbers of a report mean, with $T$ counted steps and $n$ components of the state."""
    angles = any(component.unit == "rad" for component in task.components)
    x, y = task.map_components
    found = [
        Passage(
            "Error",
            "Estimate minus truth"
            + (", angles brought to ±180°." if angles else ".")
            + " RMSE is its root mean square "
            f"over the counted steps of all traces. The position error is the distance over {x} and {y}.",
            (r"e_t = m_t - x_t , \quad \text{RMSE} = \sqrt{ \frac{1}{T} \sum_t e_t^2 }",),
        )
    ]
    if trace.has_covariance:
        found += [
            Passage(
                "NEES/n",
                "Normalised estimation error squared over the number of components: 1 on average where the covariance "
                "is right, more where it claims too much, less where it claims too little.",
                (r"\text{NEES}_t / n = \frac{1}{n} e_t^\top S_t^{-1} e_t",),
            ),
            Passage(
                "Coverage of 95 %",
                "Share of steps at which the truth lies in the ellipsoid that should hold it 95 % of the time: 95 % "
                "where the covariance is right.",
                (r"e_t^\top S_t^{-1} e_t \le \chi^2_{n, 0.95}",),
            ),
            Passage(
                "NLL",
                "Mean negative log-likelihood of the truth under the stated Gaussian, in nats: lower is better.",
                (r"\text{NLL} = \frac{1}{2 T} \sum_t ( e_t^\top S_t^{-1} e_t + \ln | S_t | + n \ln 2 \pi )",),
            ),
        ]
    if trace.log_weights is not None:
        found.append(
            Passage(
                "Effective sample size",
                "How many particles of equal weight would tell as much; of the weights before resampling.",
                (r"\text{ESS} = ( \sum_i w_i^2 )^{-1}",),
            )
        )
    if trace.acting is not None:
        found.append(
            Passage(
                "Acting share",
                "What a modality really had in the fused result, whatever weight it was given; shares sum to one.",
            )
        )
    return found


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names) if names else "none"
