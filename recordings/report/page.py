"""The page of a report: self-contained HTML with its style, figures and equations, without scripts."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from types import SimpleNamespace

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from latex2mathml.converter import convert
from markupsafe import Markup, escape

from beliefscope import __version__
from beliefscope.datasets.episode import durations_text
from beliefscope.datasets.text import plural, typeset
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.diagnostics.views import Table, Value
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.restarts import restarts_text
from beliefscope.recordings.report.sections import Item, Report, Section, number_text, text_columns
from beliefscope.recordings.report.text import definitions, methods

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
"""Content security policy: the page cannot load anything, whatever text it contains."""


def page(
    report: Report, diagnosis: Section, summary: Section, diagnostics: Sequence[Section], events: Sequence[Section]
) -> str:
    """The complete HTML page."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    environment.filters |= {
        "code": _code,
        "inline_math": _inline_math,
        "inline_svg": lambda item, number: inline_svg(item, f"f{number}-"),
        "math": mathml,
        "number": _number,
        "text_columns": text_columns,
        "typeset": typeset,
    }
    figures, tables = count(1), count(1)
    first = report.traces[0]
    return environment.get_template("report.html.j2").render(
        policy=POLICY,
        version=__version__,
        numbers=SimpleNamespace(figure=lambda: next(figures), table=lambda: next(tables)),
        report=report,
        diagnosis=diagnosis,
        summary=summary,
        diagnostics=diagnostics,
        events=events,
        header=_header(report, summary),
        provenance=_provenance(report),
        episodes=_episodes(report),
        methods=methods(first, report.checkpoint),
        definitions=definitions(first.task, first),
    )


def mathml(tex: str, display: str = "inline") -> Markup:
    """A TeX equation as MathML, which browsers render without scripts."""
    return Markup(convert(tex, display=display))


def _inline_math(text: str) -> Markup:
    """Text with TeX between dollars; every second part is an equation."""
    parts = text.replace("\n", " ").split("$")
    return Markup("").join(mathml(part) if i % 2 else escape(part) for i, part in enumerate(parts))


def _code(text: str) -> Markup:
    """Typeset text with commands between backticks."""
    code = Markup("<code>{}</code>")
    parts = enumerate(text.split("`"))
    return Markup("").join(code.format(part) if i % 2 else escape(typeset(part)) for i, part in parts)


def inline_svg(item: Item, prefix: str) -> Markup:
    """The drawing of an SVG file without prologue and metadata, with unique ids and a label."""
    svg = item.svg[item.svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{prefix}", svg)
    width = re.search(r'\bwidth="([\d.]+)pt"', svg)
    narrow = f' style="max-width: {float(width[1]) * 1.8:.0f}px"' if width and float(width[1]) < 400.0 else ""
    label = f'<svg role="img" aria-label="{escape(item.caption)}"{narrow}'
    return Markup(svg.replace("<svg", label, 1).strip())


def _header(report: Report, summary: Section) -> dict[str, str]:
    first = report.traces[0]
    episodes = ", ".join(str(trace.episode_index) for trace in report.traces)
    steps = plural(sum(map(len, report.traces)), "step")
    durations = durations_text([trace.episode for trace in report.traces])
    base = {} if report.checkpoint is None else report.checkpoint.record.get("base") or {}
    origin = f", fine-tuned from checkpoint {base['hash'][:12]}" if "hash" in base else ""
    facts = {
        "Filter": f"{first.filter} ({first.kind if first.kind == 'external' else first.kind.upper()}){origin}",
        "Task": first.task.name,
        "Modalities": ", ".join(first.modalities) or "not distinguished",
        "Episodes": f"{episodes}: {steps} in total, {durations}",
        "Sensor faults": "; ".join(dict.fromkeys(_faults(trace) for trace in report.traces)),
    }
    if texts := list(filter(None, map(restarts_text, report.traces))):
        facts["Restarts"] = "; ".join(dict.fromkeys(texts))
    if first.particle_count is not None:
        facts["Particles"] = str(first.particle_count)
    main = first.task.main_error
    table = next(item.table for item in summary.items if item.table is not None)
    column = table.columns.index(first.task.main_error.label)
    rows = sorted(table.rows, key=lambda row: row[0] != measures.layer_label("fused"))  # the fused estimate first
    errors = "; ".join(f"{row[0]} {_number(row[column])} {main.unit}".rstrip() for row in rows)
    scored = sum(int(measures.counted(trace).sum()) for trace in report.traces)
    return facts | {f"{main.title} RMSE": f"{errors} over {plural(scored, 'counted step')}"}


def _faults(trace: Trace) -> str:
    return ", ".join(fault.describe() for fault in trace.faults) or "none"


def _provenance(report: Report) -> dict[str, str]:
    hash_ = report.traces[0].checkpoint_hash
    facts = {"Checkpoint": f"SHA-256 {hash_}" if hash_ else "none: recorded estimates"}
    if report.checkpoint is not None:
        if isinstance(report.checkpoint, ExternalFilter):
            facts["Source"] = report.checkpoint.source
        for key, name in (("command", "Training command"), ("data_hash", "Training data")):
            if report.checkpoint.record.get(key):
                facts[name] = str(report.checkpoint.record[key])
    facts["Seed"] = ", ".join(dict.fromkeys(str(trace.seed) for trace in report.traces))
    return facts | {"Versions": ", ".join(f"{name} {version}" for name, version in report.versions.items())}


def _episodes(report: Report) -> Table:
    columns = ("episode", "steps", "faults", "SHA-256 of the episode")
    rows = tuple((t.episode_index, len(t), str(t.faults) or "none", t.data_hash) for t in report.traces)
    return Table("Episodes", columns, rows)


def _number(value: Value) -> str:
    """Three significant digits; a dash for missing values."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "\N{EN DASH}"
    if not isinstance(value, float):
        return _code(str(value))
    return number_text(value).replace("-", "\N{MINUS SIGN}")
