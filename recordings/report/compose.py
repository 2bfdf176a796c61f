"""Writes a report of traces of one filter: a folder with a self-contained page, figures, tables and data.

    FOLDER/report.html       self-contained      FOLDER/figures/*.svg, *.pdf     FOLDER/tables/*.csv
    FOLDER/manifest.json     hashes              FOLDER/data/*.json, *.npz

The same traces give the same bytes, except for the date in the manifest.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure

from beliefscope import __version__
from beliefscope.datasets.episode import step_text
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.catalog import DIAGNOSTICS, run_diagnostics
from beliefscope.inspect.diagnostics import weight_audit
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
from beliefscope.inspect.diagnostics.plotting import charts_of, write_figure
from beliefscope.inspect.diagnostics.views import Table, as_json
from beliefscope.inspect.figures import paper
from beliefscope.inspect.figures.top_view import draw_step, draws_force, scene_footprints
from beliefscope.inspect.maps.availability import no_maps
from beliefscope.inspect.maps.map_engine import FINE, MapEngine, Quantity
from beliefscope.inspect.maps.plane import is_outside
from beliefscope.inspect.slices.report import check_episodes, slices_of
from beliefscope.inspect.standalone import standalone_runs
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.sensors import displayed_sensors
from beliefscope.recordings.report.diagnosis import report_diagnosis
from beliefscope.recordings.report.figures import error_figure, event_figure, zoom_of
from beliefscope.recordings.report.folder import FORMAT, new_folder
from beliefscope.recordings.report.latex import latex_table
from beliefscope.recordings.report.page import page
from beliefscope.recordings.report.pdf import print_page
from beliefscope.recordings.report.sections import (
    Event,
    Item,
    Report,
    Section,
    accuracy,
    event_summary,
    event_table,
    worst_events,
)

MAP_CAPTION = (
    "Maps over offsets from the true state, each relative to its maximum. "
    "Cross hairs: true state. Rings: estimate of each layer, which also depends on the prediction."
)
SLICES = ("Slices", "Under which conditions is the error larger?")
"""Title of the section on data slices, and the question that it answers."""

MAX_CHARTS = 8
"""Maximum number of error charts; shows the traces with the largest RMSE."""


def compose(
    traces: Sequence[Trace],
    checkpoint: Checkpoint | None,
    *,
    files: Sequence[Path] = (),
    title: str = "",
    steps: Sequence[tuple[int, int]] = (),
    slow: bool = False,
    link: Callable[[int, int], str] = lambda trace, step: "",
    links_note: str = "",
    commands: tuple[str, ...] = (),
    quantity: Quantity | None = None,
    profile: HealthyProfile | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Report:
    """Compute the contents of a report, including the diagnosis and every applicable diagnostic.

    Args:
        checkpoint: of the filter; without it there are no maps.
        files: of the traces.
        steps: (index in ``traces``, step) of the events. Default: the steps with the largest error.
        slow: whether to run slow diagnostics.
        link: permalink of an event.
        links_note: how to open permalinks, or why there are none.
        commands: command lines that reproduce the report.
        quantity: of the maps; by default the first one that the filter has.
        profile: healthy record of the diagnosis; by default that of the checkpoint.
    """
    first, main = traces[0], traces[0].task.main_error.name
    options = {name: {"quantity": quantity} if "quantity" in e.options else {} for name, e in DIAGNOSTICS.items()}
    diagnosis = report_diagnosis(traces, checkpoint, profile, link, lambda share: progress(0.5 * share))
    results, reasons = run_diagnostics(traces, checkpoint, options, slow, lambda share: progress(0.5 + 0.4 * share))
    titles = {name: (DIAGNOSTICS[name].title, DIAGNOSTICS[name].question) for name in results}
    reasons = {DIAGNOSTICS[name].title: reason for name, reason in reasons.items()}
    try:
        check_episodes(len({trace.episode_index for trace in traces}))
        results["slices"] = slices_of(traces, progress=lambda share: progress(0.9 + 0.1 * share))
        titles["slices"] = SLICES
    except BadInput as error:
        reasons[SLICES[0]] = str(error)
    events = [Event(index, step) for index, step in steps] or worst_events(traces)
    return Report(
        title=title or f"{first.filter} on {first.task.name}",
        traces=tuple(traces),
        checkpoint=checkpoint,
        diagnosis=diagnosis,
        results=results,
        titles=titles,
        reasons=reasons,
        events=tuple(replace(event, link=link(event.trace, event.step)) for event in events),
        events_note="Requested steps." if steps else f"Steps with the largest {main} error, in descending order.",
        links_note=links_note,
        commands=commands,
        quantity=quantity,
        sources=tuple({"file": f.name, "sha256": hashlib.sha256(f.read_bytes()).hexdigest()} for f in files),
        versions={
            "beliefscope": __version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "numpy": np.__version__,
            "matplotlib": matplotlib.__version__,
        },
    )


def parse_event(text: str, traces: Sequence[Trace]) -> tuple[int, int]:
    """Index of the trace and step of a text such as 68 or 9:68.

    Raises BadInput for another text, and for a step or an episode that the traces do not have.
    """
    episode, _, step = text.rpartition(":")
    if not step.isdecimal() or (episode and not episode.isdecimal()):
        raise BadInput(f"--event {text!r} is not STEP or EPISODE:STEP, such as 68 or 9:68")
    episodes = [trace.episode_index for trace in traces]
    if not episode and len(traces) > 1:
        raise BadInput(f"--event {text!r} is ambiguous for {len(traces)} traces: write {episodes[0]}:{step}")
    if episode and int(episode) not in episodes:
        raise BadInput(f"--event {text!r}: no trace of episode {episode}. Available: {', '.join(map(str, episodes))}.")
    index = episodes.index(int(episode)) if episode else 0
    if int(step) >= len(traces[index]):
        raise BadInput(f"--event {text!r}: episode {episodes[index]} has steps 0 to {len(traces[index]) - 1}")
    return index, int(step)


class Writer:
    """Writes figures, tables and data of a report to a folder, and returns them as sections of the page."""

    def __init__(self, report: Report, folder: Path) -> None:
        self.report, self.folder = report, folder
        for name in ("figures", "tables", "data"):
            (folder / name).mkdir()
        self.no_maps: str | None = "the filter's checkpoint is not available"
        if report.checkpoint is not None:
            self.no_maps = no_maps(report.checkpoint, report.traces[0], report.quantity)
        self._engines: dict[int, MapEngine] = {}

    def figure(self, name: str, caption: str, figure: Figure, *data: str) -> Item:
        """Write a figure as SVG and PDF."""
        files = tuple(f"figures/{name}.{suffix}" for suffix in ("svg", "pdf"))
        for file in files:
            write_figure(figure, self.folder / file)
            figure.set_layout_engine("none")  # both files have the layout of the first, which takes most of the time
        return Item(caption, (*files, *data), svg=(self.folder / files[0]).read_text(encoding="utf-8"))

    def table(self, name: str, table: Table) -> Item:
        """Write a table as CSV with all digits, where missing values are empty, and as LaTeX as on the page."""
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([table.columns, *table.rows])
        contents = {"csv": text.getvalue(), "tex": latex_table(table)}
        files = (self.write(f"tables/{name}.{suffix}", content.encode()) for suffix, content in contents.items())
        return Item(table.title, tuple(files), table)

    def write(self, file: str, data: bytes) -> str:
        """Write a file; returns its path in the folder."""
        (self.folder / file).write_bytes(data)
        return file

    def summary(self) -> Section:
        """Accuracy over all traces, and the error over time with marked events."""
        traces = self.report.traces
        rmse = [float(np.sqrt(np.mean(measures.main_error(t)[measures.counted(t), -1] ** 2))) for t in traces]
        charts = sorted(sorted(range(len(traces)), key=lambda i: -rmse[i])[:MAX_CHARTS])
        marks: dict[int, list[tuple[int, str]]] = {}
        for number, event in enumerate(self.report.events, start=1):
            if event.trace in charts:
                marks.setdefault(charts.index(event.trace), []).append((event.step, str(number)))
        omitted = (
            f" The {MAX_CHARTS} of {len(traces)} traces with the largest errors." if len(charts) < len(traces) else ""
        )
        bands = {
            "shaded: contact": any(traces[i].episode.contact.any() for i in charts),
            "gray: image blackout": any(measures.blackout(traces[i]).any() for i in charts),
            "dotted: the events below": bool(marks),
        }
        drawn = "; ".join(name for name, is_drawn in bands.items() if is_drawn)
        legend = f" {drawn.capitalize()}." if drawn else ""
        updates = "single-modality updates of the fused filter's prior, which are not standalone filters, and of the "
        caption = (
            f"{traces[0].task.main_error.title} error of the "
            f"{updates if traces[0].modalities_with_posterior else ''}fused estimate.{legend}{omitted}"
        )
        items = [
            self.table("accuracy", accuracy(traces, standalone_runs(traces, self.report.checkpoint))),
            self.figure("error", caption, error_figure([traces[i] for i in charts], marks)),
        ]
        worst = traces[int(np.argmax(rmse))]
        if weight_audit.why_not(worst) is None:
            caption = f"Estimates of the map components, and fusion weights. Episode {worst.episode_index}."
            items.append(self.figure("estimates", caption, paper.weights_figure(worst)))
        if self.no_maps is None and worst.modalities_with_posterior and worst.episode.contact.any():
            assert self.report.checkpoint is not None
            steps = paper.steps_by_contact(worst.episode, worst.episode_index)
            if no_maps(self.report.checkpoint, worst, self.report.quantity, list(steps.values())) is None:
                figure = paper.maps_figure(self.report.checkpoint, worst, steps, quantity=self.report.quantity)
                caption = (
                    "Likelihood or posterior (see the titles) of each modality around the true position, episode "
                    f"{worst.episode_index}, in the middle of the longest stretch of contact and of free motion."
                )
                items.append(self.figure("maps-by-contact", caption, figure))
        return Section("summary", "Accuracy", "", "", tuple(items))

    def diagnosis(self) -> Section:
        """Headline of the diagnosis, ranked causes, evidence and next actions; or why there is none."""
        diagnosis = self.report.diagnosis
        result, title, question = diagnosis.result, "Diagnosis", "What is the probable cause of a fault?"
        if result is None:
            return Section("diagnosis", title, question, f"Not available: {diagnosis.reason}.", ())
        items = [self.table(f"diagnosis-{i}", table) for i, table in enumerate(result.tables(), start=1)]
        if items:
            data = self.write("data/diagnosis.json", _json(result.to_json()))
            items[0] = replace(items[0], files=(*items[0].files, data))
        return Section("diagnosis", title, question, result.headline, tuple(items), diagnosis.link)

    def diagnostic(self, name: str) -> Section:
        """Figure, tables and data of a diagnostic."""
        result, (title, question) = self.report.results[name], self.report.titles[name]
        data = self.write(f"data/{name}.json", _json(result.to_dict()))
        items = []
        if result.curves() or result.plots() or result.images():
            figure = result.plot(self.report.traces[0].episode.time)
            figure.suptitle("")  # the verdict is on the page as text
            names = [*(chart for chart, _ in charts_of(result)), *(plot.title for plot in result.plots())]
            names += [image.title for image in result.images()]
            items.append(self.figure(name, f"{title}: {'; '.join(names)}", figure, data))
        items += [self.table(f"{name}-{i}", table) for i, table in enumerate(result.tables(), start=1)]
        return Section(name, title, question, result.verdict, tuple(items))

    def event(self, index: int) -> Section:
        """Scene, images, maps and values of an event."""
        event = self.report.events[index]
        trace, step = self.report.traces[event.trace], event.step
        name = f"event-{index + 1}"
        map_ = zoomed = None
        zoom, data = 1, []
        quantity = self.report.quantity
        reason = self.no_maps or self._engine(event.trace).no_map(step, quantity)
        if reason is None:
            map_ = zoomed = self._engine(event.trace).map(step, size=FINE, quantity=quantity)
            buffer = io.BytesIO()
            arrays: dict[str, Any] = {f.name: np.asarray(getattr(map_, f.name)) for f in fields(map_)}
            np.savez_compressed(buffer, **arrays)
            data.append(self.write(f"data/{name}-maps.npz", buffer.getvalue()))
            caption, zoom = f"{map_.title}. {MAP_CAPTION}", zoom_of(map_)
            if zoom > 1:
                caption += f" Centre of the map, magnified {zoom} times."
            if is_outside(trace, step):
                caption += " The fused estimate is outside of the map."
                zoomed = self._engine(event.trace).map(step, size=FINE * zoom, quantity=quantity)
        else:
            caption = f"Estimates as offsets from the true position. No maps: {reason}."
        if any(not sensor.points for sensor in displayed_sensors(trace)):
            caption = f"Inputs of the filter. {caption}"
        scene = [] if trace.task.floor is None else [draw_step(trace, step, zoomed)]
        has_map = zoomed is not None
        items = (
            *(self.figure(f"{name}-scene", scene_caption(trace, step, has_map), figure) for figure in scene),
            self.figure(name, caption, event_figure(trace, step, zoomed, zoom), *data),
            self.table(name, event_table(trace, step, map_)),
        )
        title = f"{index + 1}. Episode {trace.episode_index}, {step_text(step, trace.episode.time_of(step))}"
        return Section(name, title, "", event_summary(trace, step), items, event.link)

    def _engine(self, trace: int) -> MapEngine:
        assert self.report.checkpoint is not None
        if trace not in self._engines:
            self._engines[trace] = MapEngine(self.report.checkpoint, self.report.traces[trace])
        return self._engines[trace]


def write_report(
    report: Report,
    folder: Path,
    chromium: str | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
) -> dict[str, Any]:
    """Write the folder of a report atomically; returns its manifest.

    Args:
        chromium: path of a browser that prints ``report.pdf``; None for no PDF.
        progress: called with the completed fraction, 0..1.

    Raises:
        BadInput: the folder contains something other than a report.
    """
    total = 3 + len(report.results) + len(report.events)
    with new_folder(folder) as target:
        writer = Writer(report, target)
        sections: list[Section] = [writer.diagnosis(), writer.summary()]
        progress(2 / total)
        for name in report.results:
            sections.append(writer.diagnostic(name))
            progress(len(sections) / total)
        for index in range(len(report.events)):
            sections.append(writer.event(index))
            progress(len(sections) / total)
        diagnosis, summary, *others = sections
        diagnostics, events = others[: len(report.results)], others[len(report.results) :]
        writer.write("report.html", page(report, diagnosis, summary, diagnostics, events).encode())
        if chromium is not None:
            print_page(chromium, target / "report.html", target / "report.pdf")
        document = manifest(report, target)
        writer.write("manifest.json", _json(document))
    return document


def manifest(report: Report, folder: Path) -> dict[str, Any]:
    """Sources and versions of a report, and the SHA-256 of each of its files."""
    first, checkpoint = report.traces[0], report.checkpoint
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {
        "format": FORMAT,
        "title": report.title,
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "task": first.task.name,
        "filter": first.filter,
        "checkpoint_hash": first.checkpoint_hash,
        "training": None if checkpoint is None else dict(checkpoint.record),
        "traces": [
            {
                **source,
                "episode": trace.episode_index,
                "steps": len(trace),
                "data_hash": trace.data_hash,
                "seed": trace.seed,
                "faults": trace.faults.to_json(),
                "settings": dict(trace.settings),
            }
            for source, trace in zip(report.sources or ({},) * len(report.traces), report.traces, strict=True)
        ],
        "events": [{"episode": report.traces[e.trace].episode_index, **asdict(e)} for e in report.events],
        "diagnosis": None if report.diagnosis.result is None else report.diagnosis.result.headline,
        "diagnostics": {name: result.verdict for name, result in report.results.items()},
        "not_made": dict(report.reasons),
        "versions": dict(report.versions),
        "commands": list(report.commands),
        "files": {str(p.relative_to(folder).as_posix()): hashlib.sha256(p.read_bytes()).hexdigest() for p in files},
    }


def _json(document: Mapping[str, Any]) -> bytes:
    return json.dumps(as_json(document), indent=1, allow_nan=False, ensure_ascii=False).encode()


def scene_caption(trace: Trace, step: int, has_map: bool) -> str:
    """Caption of ``draw_step``, with the parts that its figure has."""
    contents = ["2 sigma contours"] if trace.has_covariance else []
    contents += ["particles coloured by weight"] if trace.particles is not None else []
    belief = "; ".join(filter(None, [f"belief{' over the fused map' * has_map}", " and ".join(contents)]))
    if not scene_footprints(trace, trace.task, step):
        return f"From above: the true and the estimated position, and the {belief}"
    has_outline = trace.task.outline is not None
    objects = "the object at its true state (solid) and at its estimated state (dashed)"
    parts = [f"The scene from above with {objects if has_outline else 'the true and the estimated position'}."]
    if draws_force(trace, step):
        parts.append("Arrow: force on the end effector, 4 cm per 10 N.")
    return " ".join([*parts, f"Right: the {belief}"])
