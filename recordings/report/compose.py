"""A report: what traces of one filter tell, as a folder of figures, tables and data, and a page that stands alone.

    FOLDER/report.html       self-contained      FOLDER/figures/*.svg, *.pdf     FOLDER/tables/*.csv
    FOLDER/manifest.json     hashes of the rest  FOLDER/data/*.json, *.npz

The folder is made under another name and renamed when it is whole. The same traces give the same bytes, the manifest's
date aside.
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
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnostics import weight_audit
from beliefscope.inspect.diagnostics.base import Table, as_json
from beliefscope.inspect.diagnostics.plotting import charts_of, write_figure
from beliefscope.inspect.figures import paper
from beliefscope.inspect.figures.top_view import snapshot
from beliefscope.inspect.likelihood import FINE, MapEngine, no_maps
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace
from beliefscope.recordings.report.figures import error_figure, moment_figure, zoom_of
from beliefscope.recordings.report.folder import FORMAT, new_folder
from beliefscope.recordings.report.page import page
from beliefscope.recordings.report.sections import (
    Moment,
    Report,
    Section,
    Shown,
    accuracy,
    happening,
    moment_table,
    worst_moments,
)

SCENE = (
    "The scene from above, its object as it was (line) and as the filter takes it to be (dashed). Arrow: the force on "
    "the hand, 4 cm for 10 N. Beside it the belief, its likelihood beneath: 2 sigma contours, and particles, redder "
    "the more they weigh."
)
CHARTS = 8
"""Traces whose errors are drawn, those of the largest RMSE."""


def compose(
    traces: Sequence[Trace],
    checkpoint: Checkpoint | None,
    *,
    files: Sequence[Path] = (),
    title: str = "",
    chosen: Sequence[tuple[int, int]] = (),
    every: bool = False,
    link: Callable[[int, int], str] = lambda trace, step: "",
    opened: str = "",
    commands: tuple[str, ...] = (),
    progress: Callable[[float], None] = lambda share: None,
) -> Report:
    """The report of traces of one filter, every diagnostic that applies made.

    Args:
        checkpoint: of the filter, where it is there: without it there are no maps. files: of the traces.
        chosen: (index in ``traces``, step) of the moments; without any, the worst. every: slow diagnostics too.
        link: of such a moment. opened: how links are opened, or why there are none. commands: that make it again.
    """
    first = traces[0]
    found, refused = {}, {}
    for done, (name, entry) in enumerate(DIAGNOSTICS.items(), start=1):
        why = next(filter(None, (entry.refusal(trace, checkpoint) for trace in traces)), None)
        if why is None and entry.slow and not every:
            why = "takes a while: ask for it with --all"
        if why is None:
            found[name] = entry(traces, checkpoint)
        else:
            refused[entry.title] = why
        progress(done / len(DIAGNOSTICS))
    moments = [Moment(index, step) for index, step in chosen] or worst_moments(traces)
    how = "Those that were asked for." if chosen else "The steps with the largest position error, the worst first."
    return Report(
        title=title or f"{first.filter} on {first.episode.task}",
        traces=tuple(traces),
        checkpoint=checkpoint,
        found=found,
        asked={name: (DIAGNOSTICS[name].title, DIAGNOSTICS[name].question) for name in found},
        refused=refused,
        moments=tuple(replace(one, link=link(one.trace, one.step)) for one in moments),
        chosen=how,
        links=opened,
        commands=commands,
        sources=tuple({"file": f.name, "sha256": hashlib.sha256(f.read_bytes()).hexdigest()} for f in files),
        versions=versions(),
    )


class Writer:
    """Puts a report's parts into a folder, and keeps what the page shows of them."""

    def __init__(self, report: Report, folder: Path) -> None:
        self.report, self.folder = report, folder
        for name in ("figures", "tables", "data"):
            (folder / name).mkdir()
        if report.checkpoint is None:
            self.no_maps: str | None = "the filter's checkpoint is not at hand"
        else:
            self.no_maps = no_maps(report.checkpoint, report.traces[0])
        self._engines: dict[int, MapEngine] = {}

    def figure(self, name: str, caption: str, figure: Figure, *data: str) -> Shown:
        """As SVG and PDF; the page has the SVG."""
        files = tuple(f"figures/{name}.{ending}" for ending in ("svg", "pdf"))
        for file in files:
            write_figure(figure, self.folder / file)
        return Shown(caption, (*files, *data), svg=(self.folder / files[0]).read_text(encoding="utf-8"))

    def table(self, name: str, table: Table) -> Shown:
        """As CSV with all digits, unknown values empty."""
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([table.columns, *table.rows])
        return Shown(table.title, (self.write(f"tables/{name}.csv", text.getvalue().encode()),), table)

    def write(self, file: str, data: bytes) -> str:
        (self.folder / file).write_bytes(data)
        return file

    def summary(self) -> Section:
        """Accuracy of all traces, and the runs with their moments."""
        traces = self.report.traces
        rmse = [float(np.sqrt(np.mean(measures.position_error(t)[measures.counted(t), -1] ** 2))) for t in traces]
        drawn = sorted(sorted(range(len(traces)), key=lambda i: -rmse[i])[:CHARTS])
        marks: dict[int, list[tuple[int, str]]] = {}
        for number, moment in enumerate(self.report.moments, start=1):
            if moment.trace in drawn:
                marks.setdefault(drawn.index(moment.trace), []).append((moment.step, str(number)))
        left_out = f" The {CHARTS} of {len(traces)} traces with the largest errors." if len(drawn) < len(traces) else ""
        caption = (
            "Position error of each modality alone and fused over the steps. Shaded: contact; gray: black pictures. "
            f"Dotted: the moments that are shown below.{left_out}"
        )
        shown = [
            self.table("accuracy", accuracy(traces)),
            self.figure("error", caption, error_figure([traces[i] for i in drawn], marks)),
        ]
        worst = traces[int(np.argmax(rmse))]
        if weight_audit.why_not(worst) is None:
            caption = f"Estimates of the map's components, and fusion weight_audit. Episode {worst.episode_index}."
            shown.append(self.figure("estimates", caption, paper.weights_figure(worst)))
        if self.no_maps is None and worst.alone and worst.episode.contact.any():
            assert self.report.checkpoint is not None
            figure = paper.maps_figure(self.report.checkpoint, worst, paper.steps_by_contact(worst))
            caption = (
                f"Likelihood of each modality over the square about the truth, episode {worst.episode_index}: in the "
                "middle of the longest stretch in contact, and of the longest without."
            )
            shown.append(self.figure("maps-by-contact", caption, figure))
        return Section("summary", "Accuracy", "", "", tuple(shown))

    def diagnostic(self, name: str) -> Section:
        """One diagnostic's figure, tables and data."""
        result, (title, question) = self.report.found[name], self.report.asked[name]
        data = self.write(f"data/{name}.json", _json(result.to_dict()))
        shown = []
        if result.curves() or result.plots() or result.pictures():
            figure = result.plot()
            figure.suptitle("")  # the page has the verdict as text, and a paper has captions
            names = [*(chart for chart, _ in charts_of(result)), *(p.title for p in result.plots())]
            names += [picture.title for picture in result.pictures()]
            shown.append(self.figure(name, f"{title}: {'; '.join(names)}", figure, data))
        for i, table in enumerate(result.tables(), start=1):
            shown.append(self.table(f"{name}-{i}", table))
        return Section(name, title, question, result.verdict, tuple(shown))

    def moment(self, number: int) -> Section:
        """One moment: the scene, pictures, maps, numbers."""
        moment = self.report.moments[number]
        trace, step = self.report.traces[moment.trace], moment.step
        name = f"moment-{number + 1}"
        map_ = drawn = None
        zoom, data = 1, []
        if self.no_maps is None:
            map_ = drawn = self._engine(moment.trace).map(step, size=FINE)
            buffer = io.BytesIO()
            arrays: dict[str, Any] = {f.name: np.asarray(getattr(map_, f.name)) for f in fields(map_)}
            np.savez_compressed(buffer, **arrays)
            data.append(self.write(f"data/{name}-maps.npz", buffer.getvalue()))
            caption = (
                "What the filter was given, and likelihood maps over offsets from the truth, each over its maximum. "
                "Cross hairs: the truth. Rings: each layer's own estimate, which rests on its prediction as well."
            )
            zoom = zoom_of(map_)
            if zoom > 1:
                caption += f" The middle of the map, {zoom} times narrower than its square."
                drawn = self._engine(moment.trace).map(step, size=FINE * zoom)
        else:
            caption = (
                f"What the filter was given, and its estimates as offsets from the truth. No maps: {self.no_maps}."
            )
        shown = (
            self.figure(f"{name}-scene", SCENE, snapshot(trace, step, drawn)),
            self.figure(name, caption, moment_figure(trace, step, drawn, zoom), *data),
            self.table(name, moment_table(trace, step, map_)),
        )
        title = f"{number + 1}. Episode {trace.episode_index}, step {step}"
        return Section(name, title, "", happening(trace, step), shown, moment.link)

    def _engine(self, trace: int) -> MapEngine:
        assert self.report.checkpoint is not None
        if trace not in self._engines:
            self._engines[trace] = MapEngine(self.report.checkpoint, self.report.traces[trace])
        return self._engines[trace]


def write_report(
    report: Report,
    folder: Path,
    pdf: Callable[[Path, Path], None] | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> dict[str, Any]:
    """Writes the report's folder, whole or not at all, and returns its manifest.

    Args:
        pdf: prints (page, PDF), for a ``report.pdf``. progress: called with the share done, 0..1.

    Raises:
        BadInput: the folder holds something else than a report.
    """
    parts = 1 + len(report.found) + len(report.moments)
    with new_folder(folder) as made:
        writer = Writer(report, made)
        summary = writer.summary()
        progress(1 / (parts + 1))
        sections: list[Section] = []
        for done, name in enumerate(report.found, start=2):
            sections.append(writer.diagnostic(name))
            progress(done / (parts + 1))
        moments: list[Section] = []
        for number in range(len(report.moments)):
            moments.append(writer.moment(number))
            progress((2 + len(sections) + number) / (parts + 1))
        writer.write("report.html", page(report, summary, sections, moments, writer.no_maps).encode())
        if pdf is not None:
            pdf(made / "report.html", made / "report.pdf")
        document = manifest(report, made)
        writer.write("manifest.json", _json(document))
    return document


def manifest(report: Report, folder: Path) -> dict[str, Any]:
    """What the report was made of and by, and the SHA-256 of each of its files."""
    first, checkpoint = report.traces[0], report.checkpoint
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {
        "format": FORMAT,
        "title": report.title,
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "task": first.episode.task,
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
        "moments": [{"episode": report.traces[m.trace].episode_index, **asdict(m)} for m in report.moments],
        "diagnostics": {name: result.verdict for name, result in report.found.items()},
        "not_made": dict(report.refused),
        "versions": dict(report.versions),
        "commands": list(report.commands),
        "files": {str(p.relative_to(folder).as_posix()): hashlib.sha256(p.read_bytes()).hexdigest() for p in files},
    }


def versions() -> dict[str, str]:
    """Of what the numbers and figures come from."""
    return {
        "beliefscope": __version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
        "matplotlib": matplotlib.__version__,
    }


def _json(document: Mapping[str, Any]) -> bytes:
    return json.dumps(as_json(document), indent=1, allow_nan=False, ensure_ascii=False).encode()
