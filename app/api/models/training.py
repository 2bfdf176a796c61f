"""Models of JSON responses: lineage, fine-tuning and studies."""

from __future__ import annotations

from typing import Any, Literal

from beliefscope.app.api.models.catalog import Number, Reply
from beliefscope.app.api.models.results import ResultViews
from beliefscope.app.jobs.queue import Job


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
    rmse: dict[str, Number]
    before: dict[str, dict[str, Number]]
    after: dict[str, dict[str, Number]]


class Lineage(Reply):
    """Fine-tuned checkpoints and their ancestors, bases first."""

    members: list[LineageMember]


class ModuleInfo(Reply):
    """A module of a filter. gradient, change: of the fine-tuning that wrote the checkpoint."""

    name: str
    kind: str
    description: str
    parameters: int
    depth: int
    gradient: Number = None
    change: Number = None


class PresetInfo(Reply):
    """A preset. trains: names of parameters."""

    name: str
    trains: list[str]


class SliceInfo(Reply):
    """A slice of a data set (``filters.finetuning.slices``)."""

    name: str
    faults: list[dict[str, Any]]
    contact: bool | None
    only: list[str]
    text: str


class FineTuneRunInfo(Reply):
    """A fine-tuning run. finetuned: catalog name of its checkpoint. saved_as: its place in the catalog."""

    run: str
    task: str
    filter: str
    data: str
    settings: dict[str, Any]
    submitted: float
    job: Job | None
    finetuned: str | None
    saved_as: Literal["saved", "default"] | None


class FineTuneOffer(Reply):
    """Options for fine-tuning a filter, and runs of its task. why_not: why it cannot be fine-tuned, or None."""

    why_not: str | None
    modules: list[ModuleInfo]
    presets: list[PresetInfo]
    slices: list[SliceInfo]
    settings: dict[str, Any]
    runs: list[FineTuneRunInfo]


class ValidationInfo(Reply):
    """A validation. slices: name -> metrics (``filters.finetuning.loop.Validation``)."""

    step: int
    loss: Number
    slices: dict[str, Any]
    score: Number


class FineTuneProgress(Reply):
    """Progress of a fine-tuning run. losses: (step, loss)."""

    steps: int
    losses: list[tuple[int, Number]]
    validations: list[ValidationInfo]


class FineTunedCheckpoint(Reply):
    """A fine-tuned checkpoint."""

    name: str
    hash: str
    best_step: int
    steps: int
    seconds: float


class RegressionEvent(Reply):
    """Consecutive steps with a larger error than before (``inspect.compare.effects.Regression``), m."""

    slice: str
    faults: str
    only: list[str]
    episode: int
    first: int
    last: int
    step: int
    contact: bool
    before: Number
    after: Number
    link: str


class FineTuneResult(Reply):
    """Result of a fine-tuning run. frozen: modules with unchanged hashes."""

    finetuned: FineTunedCheckpoint
    comparison: ResultViews
    frozen: list[str]
    events: list[RegressionEvent]


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


class StudyRow(Reply):
    """A row of a study's table (``filters.training.study_table.Row``)."""

    filter: str
    blackout: Number
    seeds: int
    requested: int
    failed: int
    mean: dict[str, Number]
    spread: dict[str, Number]
    bounds: tuple[float, float] | None
    by_seed: dict[str, dict[str, Number]]


class StudyTask(Reply):
    """The part of a study for one task. data: file of the training and evaluation data."""

    name: str
    data: str
    filters: list[StudyFilter]
    rows: list[StudyRow]


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
