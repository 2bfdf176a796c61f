"""Response models of sweeps."""

from beliefscope.app.api.models.catalog import Number, Reply


class SweepInfo(Reply):
    """A sweep. faults: texts, the empty one for clean data."""

    name: str
    checkpoints: int
    rows: int
    phases: list[str]
    faults: list[str]


class SweepList(Reply):
    """All sweeps. problems: one line per unreadable sweep."""

    sweeps: list[SweepInfo]
    problems: list[str]


class ExperimentRow(Reply):
    """Results of a checkpoint over a data set in one phase.

    checkpoint, data: hashes. catalog_name, data_name: their names in the catalog; None: not in it. error, worst: in
    ``unit``, at ``worst_episode`` and ``worst_step``. worst_time: s since the first step of the episode; None without
    timestamps. training: JSON of the hash of its data, plan, blackouts, faults and the settings of a fine-tuning.
    provenance: JSON of the file beside the checkpoint.
    """

    name: str
    filter: str
    task: str
    faults: str
    episodes: int
    steps: int
    error: Number
    unit: str
    nees: Number
    coverage95: Number
    worst: Number
    worst_episode: int | None
    worst_step: int | None
    worst_time: Number
    checkpoint: str
    data: str
    training: str
    provenance: str
    catalog_name: str | None
    data_name: str | None


class Experiments(Reply):
    """Results by checkpoint, largest errors first. count: number of all rows; only the first ones are sent."""

    rows: list[ExperimentRow]
    count: int


class EpisodeResult(Reply):
    """Results of an episode in one phase; error and worst in ``unit``, worst_time as in ``ExperimentRow``."""

    episode: int
    seed: int
    policy: str
    steps: int
    error: Number
    unit: str
    worst: Number
    worst_step: int
    worst_time: Number
    nees: Number


class EpisodeResults(Reply):
    """Results of a checkpoint by episode and seed, largest errors first. opened_seed: of the runs on the page."""

    episodes: list[EpisodeResult]
    opened_seed: int
