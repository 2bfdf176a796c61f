"""Interface of diagnostics: functions of traces whose results are frozen dataclasses with views.

Fields of a result are in SI units; its views are in cm and degrees.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnostics.views import Views
from beliefscope.inspect.trace import Trace

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Diagnostic(Views):
    """Result of a diagnostic; subclasses are frozen dataclasses whose fields are its numbers."""

    def plot(self) -> Figure:
        """Curves, plots and image panels as a matplotlib figure of a paper's width."""
        from beliefscope.inspect.diagnostics.plotting import draw_figure  # matplotlib is slow to import

        return draw_figure(self)


@dataclass(frozen=True)
class Entry:
    """A diagnostic of the catalog.

    Attributes:
        name: name on the command line.
        title: display name.
        question: question that the diagnostic answers.
        run: (traces, checkpoint) -> result. The traces are of one filter; with several, results have bounds and
            intervals over trajectories. ``options`` are passed by name.
        why_not: (trace, checkpoint or None) -> one-line reason why the diagnostic does not apply, or None.
        needs: ``trace`` only, or the ``checkpoint`` too.
        slow: takes more than two seconds; computed on request only.
        options: option -> description.
    """

    name: str
    title: str
    question: str
    run: Callable[..., Diagnostic]
    why_not: Callable[[Trace, Checkpoint | None], str | None] = lambda trace, checkpoint: None
    needs: Literal["trace", "checkpoint"] = "trace"
    slow: bool = False
    options: Mapping[str, str] = field(default_factory=dict)

    def refusal(self, trace: Trace, checkpoint: Checkpoint | None) -> str | None:
        """One-line reason why the diagnostic cannot be computed, or None."""
        if self.needs == "checkpoint":
            if checkpoint is None:
                return f"{self.name} needs the filter's checkpoint, not only its trace"
            if checkpoint.hash != trace.checkpoint_hash:
                return f"the trace is from checkpoint {trace.checkpoint_hash[:12]}, not from {checkpoint.hash[:12]}"
        try:
            return self.why_not(trace, checkpoint)
        except BadInput as error:  # an external filter lacks the requested property
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
        return self.run(traces, checkpoint, **options) if self.needs == "checkpoint" else self.run(traces, **options)
