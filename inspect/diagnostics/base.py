"""Interface of diagnostics: functions of traces whose results are frozen dataclasses with views.

Fields of a result are in SI units; its views are in cm and degrees.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, get_type_hints

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput, check_name
from beliefscope.datasets.task import Task
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.unavailable import UnavailableFilter
from beliefscope.inspect.diagnostics.healthy_comparison import Comparison, compare
from beliefscope.inspect.diagnostics.healthy_profile import find_profile
from beliefscope.inspect.diagnostics.views import Views
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.measures import Mask
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.data import check_origin

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NO_DEFAULT = (None, inspect.Parameter.empty)


NO_RECORD = "No healthy record of this filter; compared with theory."
"""Start of the verdicts on filters without a healthy profile."""


class Diagnostic(Views):
    """Result of a diagnostic; subclasses are frozen dataclasses whose fields are its numbers."""

    @property
    def alarms(self) -> tuple[str, ...]:
        """Significant deviations from the filter's healthy record, or without one from theory."""
        return ()

    def plot(self, time: NDArray[np.float64] | None = None) -> Figure:
        """Curves, plots and image panels as a matplotlib figure of a paper's width.

        Args:
            time: (T,) s, ``Episode.time`` of the trace: curves are drawn over it instead of the indices of the steps.
        """
        from beliefscope.inspect.diagnostics.plotting import draw_figure  # matplotlib is slow to import

        return draw_figure(self, time)


@dataclass(frozen=True, kw_only=True)
class RunDiagnostic(Diagnostic):
    """Result over traces of one filter, whose curves have bands of phases.

    Attributes:
        task, filter, trajectories: of the traces, and their number.
        contact, blackout: (T,) masks of a single trace; (0,) for several, which have no curves.
    """

    task: Task
    filter: str
    trajectories: int
    contact: Mask
    blackout: Mask

    def bands(self) -> dict[str, Mask]:
        return {"contact": self.contact, "blackout": self.blackout} if len(self.contact) else {}


def fields_of(traces: Sequence[Trace]) -> dict[str, Any]:
    """The fields of a ``RunDiagnostic``."""
    first, keep = traces[0], drawn_steps(traces)
    masks = {"contact": first.episode.contact.astype(bool)[:keep], "blackout": measures.blackout(first)[:keep]}
    return {"task": first.task, "filter": first.filter, "trajectories": len(traces), **masks}


def drawn_steps(traces: Sequence[Trace]) -> int:
    """Number of steps with curves: all of a single trace, 0 for several."""
    return len(traces[0]) if len(traces) == 1 else 0


@dataclass(frozen=True)
class Entry:
    """A diagnostic of the catalog.

    Attributes:
        name: name on the command line.
        title: display name.
        question: question that the diagnostic answers.
        run: (traces, checkpoint) -> result. The traces are of one filter; with several, results have bounds and
            intervals over episodes. ``options`` are passed by name.
        why_not: (trace, checkpoint or None) -> one-line reason why the diagnostic does not apply, or None.
        needs: ``trace`` only, or a ``filter`` too that can be run, unlike that of a live run.
        slow: takes more than two seconds; computed on request only.
        options: option -> description.
        statistics: trace -> statistics of a healthy profile (``HealthyProfile``). Such a diagnostic takes the
            comparison with the filter's profile as ``healthy``, None if the filter has none.
    """

    name: str
    title: str
    question: str
    run: Callable[..., Diagnostic]
    why_not: Callable[[Trace, Checkpoint | None], str | None] = lambda trace, checkpoint: None
    needs: Literal["trace", "filter"] = "trace"
    slow: bool = False
    options: Mapping[str, str] = field(default_factory=dict)
    statistics: Callable[[Trace], dict[str, float]] | None = None

    @property
    def takes_progress(self) -> bool:
        """Whether ``run`` has the argument ``progress``, a callback for the share done."""
        return "progress" in inspect.signature(self.run).parameters

    def to_json(self) -> dict[str, Any]:
        """Description as JSON; the default of an option is text, empty if there is none."""
        parameters = inspect.signature(self.run).parameters
        defaults = {name: parameters[name].default for name in self.options}
        options = [
            {"name": name, "meaning": meaning, "default": "" if defaults[name] in NO_DEFAULT else str(defaults[name])}
            for name, meaning in self.options.items()
        ]
        return {name: getattr(self, name) for name in ("name", "title", "question", "slow")} | {"options": options}

    def parse_options(self, texts: Mapping[str, str]) -> dict[str, Any]:
        """Convert texts, such as those of a query string, to the types of the options; an empty text is the default.

        Raises BadInput for an unknown option or an invalid value.
        """
        from pydantic import TypeAdapter, ValidationError

        hints = get_type_hints(self.run)
        options: dict[str, Any] = {}
        for name, text in texts.items():
            check_name(f"option of {self.name}", name, self.options)
            try:
                if text:
                    options[name] = TypeAdapter(hints.get(name, str)).validate_strings(text)
            except ValidationError as error:
                option = f"option {name!r} of {self.name} ({self.options[name]})"
                raise BadInput(f"{option} is {text!r}: {error.errors()[0]['msg']}.") from None
        return options

    def refusal(self, trace: Trace, checkpoint: Checkpoint | None) -> str | None:
        """One-line reason why the diagnostic cannot be computed, or None."""
        try:
            if self.needs != "trace":
                if checkpoint is None or isinstance(checkpoint, UnavailableFilter):
                    how = "give its checkpoint, or --filter FILE.py:FUNCTION"
                    return f"diagnostic {self.name} needs the filter, not only its trace: {how}"
                check_origin(checkpoint, trace)
            return self.why_not(trace, checkpoint)
        except BadInput as error:  # also if an external filter lacks the requested property
            return str(error)

    def __call__(self, traces: Sequence[Trace], checkpoint: Checkpoint | None = None, **options: Any) -> Diagnostic:
        """Compute the result. Raises BadInput with the reason if it cannot be computed."""
        if not traces:
            raise BadInput(f"{self.name} needs at least one trace")
        for trace in traces:
            if why := self.refusal(trace, checkpoint):
                raise BadInput(why)
            if trace.checkpoint_hash != traces[0].checkpoint_hash:
                raise BadInput(
                    f"traces of two checkpoints, {traces[0].checkpoint_hash[:12]} and {trace.checkpoint_hash[:12]}: "
                    "a diagnostic needs traces of one filter"
                )
        if self.statistics is not None:
            options["healthy"] = self.compare(traces, checkpoint)
        return self.run(traces, checkpoint, **options) if self.needs != "trace" else self.run(traces, **options)

    def compare(self, traces: Sequence[Trace], checkpoint: Checkpoint | None) -> Comparison | None:
        """Compare the traces with the filter's healthy profile; None without one."""
        first = traces[0]
        profile = find_profile(first.task.name, first.filter, first.checkpoint_hash, checkpoint)
        if self.statistics is None or profile is None:
            return None
        return compare(profile, [self.statistics(trace) for trace in traces], task=traces[0].task)
