"""What a diagnostic gives, and how it is offered: numbers, a verdict, and views that page, recording and figure share.

A diagnostic is a function of traces whose result is a frozen dataclass, a ``Diagnostic``. Its fields are its numbers,
in SI units. What is shown of it are tables, curves over time and plots, in cm and degrees; whoever shows one shows all.
"""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.trace import Trace

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
Value = str | int | float | None
VIEWS = ("tables", "curves", "bands", "plots", "pictures")


@dataclass(frozen=True)
class Table:
    """Rows of values; columns name their unit. A value that is not known is None."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Value, ...], ...]


@dataclass(frozen=True)
class Curve:
    """One quantity over the steps of one trace.

    Attributes:
        name: as in a legend. values: (T,), NaN where there is none. unit: as shown.
        chart: curves of one chart share its axes. layer: modality, ``fused`` or ``truth``, which gives its colour.
        bounds: between which the values should lie, where there is such a thing.
    """

    name: str
    values: Array
    chart: str
    unit: str = ""
    layer: str = ""
    bounds: tuple[float, float] | None = None


@dataclass(frozen=True)
class Line:
    """One line of a plot: x and y (S,), and the layer that gives its colour."""

    name: str
    x: Array
    y: Array
    layer: str = ""


@dataclass(frozen=True)
class Plot:
    """Something over something else than time.

    Attributes:
        diagonal: draw y = x, the ideal, beneath. names: of x = 0, 1, ..., where x counts things.
    """

    title: str
    x_label: str
    y_label: str
    lines: tuple[Line, ...]
    kind: Literal["line", "points", "bars"] = "line"
    diagonal: bool = False
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class Picture:
    """A picture's value per pixel (H, W), such as an attribution; drawn symmetric about zero where ``signed``."""

    title: str
    values: Array
    unit: str = ""
    signed: bool = True


class Diagnostic(ABC):
    """Result of a diagnostic; subclasses are frozen dataclasses whose fields are its numbers."""

    @property
    @abstractmethod
    def verdict(self) -> str:
        """What the numbers say, in a sentence or two, each with its number."""

    def tables(self) -> list[Table]:
        """The numbers as tables."""
        return []

    def curves(self) -> list[Curve]:
        """Over the steps of the trace; none where the diagnostic is of several traces."""
        return []

    def bands(self) -> dict[str, NDArray[np.bool_]]:
        """Kind of step (``contact``, ``blackout``) -> mask (T,), to shade behind the curves."""
        return {}

    def plots(self) -> list[Plot]:
        """What is not over time."""
        return []

    def pictures(self) -> list[Picture]:
        """What is per pixel."""
        return []

    def to_dict(self) -> dict[str, Any]:
        """The verdict and all fields as JSON: arrays as lists, what is not finite as None."""
        values = {f.name: as_json(getattr(self, f.name)) for f in dataclasses.fields(self)}  # type: ignore[arg-type]
        return {"verdict": self.verdict, **values}

    def views(self) -> dict[str, Any]:
        """What is shown, as JSON: the verdict and each of ``VIEWS``."""
        shown = {name: as_json(getattr(self, name)()) for name in VIEWS}
        return {"verdict": self.verdict, **shown}

    def plot(self) -> Figure:
        """Curves, plots and pictures as a matplotlib figure in a paper's width, to be saved or shown."""
        from beliefscope.inspect.diagnostics.plotting import figure_of

        return figure_of(self)


@dataclass(frozen=True)
class Entry:
    """One line of the catalog of diagnostics.

    Attributes:
        name: as on the command line. title, question: what it is called, and the question that it answers.
        run: (traces, checkpoint) -> result. Traces are of one filter; several give bounds and intervals over
            trajectories. ``options`` are passed to it by name.
        why_not: (trace, checkpoint or None) -> why it cannot be made of this trace, in one line; None where it can.
        needs: ``trace`` alone, or the ``checkpoint`` too. slow: takes more than a second or two, so only when asked.
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
        """Why it cannot be made, in one line; None where it can."""
        if self.needs == "checkpoint":
            if checkpoint is None:
                return f"{self.name} needs the filter's checkpoint, not only its trace"
            if checkpoint.hash != trace.checkpoint_hash:
                return f"the trace was made by checkpoint {trace.checkpoint_hash[:12]}, not by {checkpoint.hash[:12]}"
        try:
            return self.why_not(trace, checkpoint)
        except BadInput as error:  # asked of a filter from outside for what only ours have
            return str(error)

    def __call__(self, traces: Sequence[Trace], checkpoint: Checkpoint | None = None, **options: Any) -> Diagnostic:
        """The result. Raises BadInput with the reason where it cannot be made."""
        if not traces:
            raise BadInput(f"{self.name} needs at least one trace")
        for trace in traces:
            if why := self.refusal(trace, checkpoint):
                raise BadInput(why)
            if trace.checkpoint_hash != traces[0].checkpoint_hash:
                raise BadInput(
                    f"traces of two checkpoints, {traces[0].checkpoint_hash[:12]} and {trace.checkpoint_hash[:12]}: "
                    "a diagnostic is of one filter"
                )
        return self.run(traces, checkpoint, **options) if self.needs == "checkpoint" else self.run(traces, **options)


def as_json(value: Any) -> Any:
    """Dataclasses, arrays and mappings as JSON values; a float that is not finite as None."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: as_json(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): as_json(one) for key, one in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return as_json(value.tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [as_json(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
