"""Models of JSON responses: lineage, fine-tuning and studies."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from pydantic import ConfigDict

from beliefscope.app.api.models.catalog import Number, Reply, fields_of
from beliefscope.app.api.models.results import ResultViews
from beliefscope.app.jobs.queue import Job
from beliefscope.app.workspace.finetune_runs import FineTuneRun
from beliefscope.filters.finetuning.choices import Choices
from beliefscope.filters.finetuning.loop import Validation
from beliefscope.filters.training.study_table import Row
from beliefscope.inspect.compare.effects import Regression
from beliefscope.inspect.compare.success import SliceChange, Success


class LineageMember(Reply):
    """A checkpoint and its base.

    Attributes:
        catalog_name: its name in the catalog, or None. run: fine-tuning run of this workspace that wrote it, or None.
        train, learned: trained modules and learned slices. rmse: by component, in cm or deg, on clean data.
        before, after: slice -> RMSE by component on the test episodes of its fine-tuning.
    """

    hash: str
    name: str
    catalog_name: str | None
    base: str | None
    run: str | None
    train: list[str]
    learned: list[str]
    rmse: Mapping[str, Number]
    before: Mapping[str, Mapping[str, Number]]
    after: Mapping[str, Mapping[str, Number]]


class Lineage(Reply):
    """Fine-tuned checkpoints and their ancestors, bases first."""

    members: list[LineageMember]


@dataclass(frozen=True)
class FineTuneRunInfo(FineTuneRun):
    """A fine-tuning run. finetuned: catalog name of its checkpoint. saved_as: its place in the catalog."""

    job: Job | None
    finetuned: str | None
    saved_as: Literal["saved", "default"] | None


@fields_of(Validation)
class ValidationInfo(Reply):
    """A validation."""

    loss: Number


class FineTuneProgress(Reply):
    """Progress of a fine-tuning run. losses: (step, loss)."""

    steps: int
    losses: list[tuple[int, Number]]
    validations: list[ValidationInfo]


class FineTunedCheckpoint(Reply):
    """A fine-tuned checkpoint. no_change: what to try, if the base checkpoint was best; else empty."""

    name: str
    hash: str
    best_step: int
    steps: int
    seconds: float
    no_change: str = ""


@fields_of(Regression)
class RegressionEvent(Reply):
    """Consecutive steps with a larger error than before."""

    link: str


@fields_of(SliceChange)
class SliceChangeInfo(Reply):
    """Change of the criterion's measure in a slice."""

    change: Number
    low: Number
    high: Number


@fields_of(Success)
class SuccessInfo(Reply):
    """Outcome by the success criterion."""

    slices: list[SliceChangeInfo]


class FineTuneResult(Reply):
    """Result of a fine-tuning run. frozen: modules with unchanged hashes. success: None without a criterion."""

    success: SuccessInfo | None = None

    finetuned: FineTunedCheckpoint
    comparison: ResultViews
    frozen: list[str]
    events: list[RegressionEvent]


@dataclass(frozen=True)
class FineTuneRunSummary(FineTuneRunInfo):
    """A fine-tuning run with its progress and its outcome by the success criterion."""

    progress: FineTuneProgress | None
    success: SuccessInfo | None


class MeasureInfo(Reply):
    """A measure of a success criterion. title: name of the quantity."""

    name: str
    title: str


@dataclass(frozen=True)
class FineTuneOffer(Choices):
    """Options for fine-tuning a filter, and runs of its task.

    simulated: number of training episodes that are simulated first; 0 if the data set has training episodes.
    """

    measures: list[MeasureInfo]
    simulated: int
    runs: list[FineTuneRunSummary]


@dataclass(frozen=True)
class FineTuneDetails(FineTuneRunInfo):
    """A fine-tuning run with its progress and result."""

    progress: FineTuneProgress | None
    result: FineTuneResult | None


class TrainedSeed(Reply):
    """A trained checkpoint of a study. file: whether it can be added to the catalog."""

    seed: int
    catalog_name: str | None
    file: bool


class StudyFilter(Reply):
    """A filter of a study and its trained checkpoints."""

    name: str
    trained: list[TrainedSeed]


class StudyTask(Reply):
    """The part of a study for one task.

    data: file of the training and evaluation data. offset_data: description of the data that rows with an offset start
    were evaluated on; empty: as the others.
    """

    model_config = ConfigDict(json_schema_serialization_defaults_required=True)  # optional fields of rows are sent

    name: str
    data: str
    offset_data: str
    filters: list[StudyFilter]
    rows: list[Row]


class StudyInfo(Reply):
    """A study. job: id of the job that trains its unfinished cells. why_not: why they cannot be trained here."""

    name: str
    preset: str
    seeds: int
    tasks: list[StudyTask]
    unfinished: int
    cells: int
    job: str | None
    why_not: str


class StudyList(Reply):
    """All studies. problems: one line per unreadable study."""

    studies: list[StudyInfo]
    problems: list[str]


class FilterName(Reply):
    """Name of a filter in the catalog."""

    filter: str
