"""Models of JSON responses: diagnosis."""

from typing import Literal

from beliefscope.app.api.models.catalog import JobReply, Number, Reply, fields_of
from beliefscope.inspect.diagnosis.cause import Evidence, Recovery


@fields_of(Evidence)
class DiagnosisEvidence(Reply):
    """A deviation that supports a cause. low, high: healthy range. episode, step: moment that shows it best."""


@fields_of(Recovery)
class DiagnosisRecovery(Reply):
    """Effect of undoing a cause: share of the excess error with its 95 % interval, and decrease of the NLL, nats."""


class DiagnosisCause(Reply):
    """A ranked cause. cause: its name in the catalog. title: in words.

    steps: first affected step, and first step after it; None for complete episodes.
    """

    cause: str
    title: str
    component: str
    probability: float
    episodes: list[int]
    steps: list[int] | None
    evidence: list[DiagnosisEvidence]
    recovered: DiagnosisRecovery | None
    next: str


class Diagnosis(Reply):
    """The probable causes of a filter's fault. masked: a sensor is faulty, and the filter is unaffected.

    deviations: largest ones, whatever their cause.
    miscalibrated: whether the healthy record itself is over- or underconfident.
    statistics: number of compared statistics by sensor, of the controls, labels, models and the filter.
    unmeasured: sensors without any, and statistics of sensors that the episodes do not have.
    """

    state: Literal["healthy", "fault", "unsure"]
    masked: bool
    headline: str
    causes: list[DiagnosisCause]
    deviations: list[DiagnosisEvidence]
    task: str
    filter: str
    checkpoint_hash: str
    episodes: int
    healthy_episodes: int
    healthy_data: str = ""
    miscalibrated: bool
    statistics: dict[str, int]
    unmeasured: list[str]
    alarm_rate: float


class DiagnosisJob(JobReply):
    """Body of a 202 response: the job, and the diagnosis of the selected run before any cause is undone."""

    preliminary: Diagnosis


class RepairedInterval(Reply):
    """The sensors to drop or restore, over the steps from the first to the last."""

    sensors: list[str]
    restored: bool
    steps: list[int]


class SmallestRepair(Reply):
    """The smallest repair of the largest failure of a run. failure: first and last step, None if there is none.

    error, repaired: RMS position error over the failure without and with the repair, m. bound: which it keeps, m.
    """

    sentence: str
    failure: list[int] | None
    bound: float
    error: Number
    repaired: Number
    repair: RepairedInterval | None
    replays: int


class HealthyRecord(Reply):
    """Which clean episodes the healthy record of a filter is from."""

    data: str
