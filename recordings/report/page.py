"""A report as one page: plain HTML with its style, figures and equations inside; no script, nothing from elsewhere."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from html import escape
from itertools import count

from beliefscope import __version__
from beliefscope.filters.external.load import Foreign
from beliefscope.inspect.diagnostics.base import Table, Value
from beliefscope.inspect.statistics import measures
from beliefscope.recordings.report.mathml import mathml
from beliefscope.recordings.report.sections import Report, Section, Shown
from beliefscope.recordings.report.text import Passage, definitions, methods

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
"""A browser that keeps to it loads nothing, whatever a text in the page might say."""

STYLE = """
:root { color-scheme: light dark; --ink: #1b1f24; --soft: #5b6470; --line: #d8dde3; --paper: #fff; --tint: #f4f6f8;
  --link: #0b5cad; }
@media screen and (prefers-color-scheme: dark) {
  :root { --ink: #e6e9ed; --soft: #9aa4b0; --line: #343b44; --paper: #14171b; --tint: #1d2228; --link: #7db8f5; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink); font: 15px/1.5 system-ui, "Segoe UI", "Noto Sans",
  "DejaVu Sans", sans-serif; }
.frame { display: grid; grid-template-columns: 13rem minmax(0, 56rem); gap: 3rem; max-width: 76rem; margin: 0 auto;
  padding: 2.5rem 2rem 4rem; }
nav { position: sticky; top: 2.5rem; align-self: start; max-height: calc(100vh - 5rem); overflow: auto;
  font-size: 13px; }
nav ol { list-style: none; margin: 0; padding: 0; }
nav li { margin: 0.3rem 0; } nav ol ol { padding-left: 0.9rem; }
a { color: var(--link); } nav a { color: var(--soft); text-decoration: none; } nav a:hover { color: var(--ink); }
header p { margin: 0.2rem 0; color: var(--soft); }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 0.4rem; }
h2 { font-size: 1.35rem; margin: 2.8rem 0 0.8rem; padding-top: 0.9rem; border-top: 1px solid var(--line); }
h3 { font-size: 1.08rem; margin: 2rem 0 0.4rem; } h4 { font-size: 0.95rem; margin: 1.1rem 0 0.2rem; }
h2, h3, h4 { break-after: avoid; }
p { margin: 0.4rem 0; max-width: 46rem; overflow-wrap: break-word; }
.question, .soft { color: var(--soft); } .question { font-style: italic; }
.verdict { border-left: 3px solid var(--link); padding: 0.1rem 0 0.1rem 0.8rem; margin: 0.6rem 0; }
dl { display: grid; grid-template-columns: max-content minmax(0, 1fr); gap: 0.25rem 1.2rem; margin: 0.8rem 0; }
dt { color: var(--soft); } dd { margin: 0; overflow-wrap: anywhere; }
figure { margin: 1.2rem 0 1.6rem; break-inside: avoid; }
.plate { background: #fff; border: 1px solid var(--line); border-radius: 4px; padding: 0.6rem; }
.plate svg { display: block; width: 100%; height: auto; margin: 0 auto; }
figcaption { font-size: 13px; margin-top: 0.4rem; break-after: avoid; }
.files { color: var(--soft); overflow-wrap: anywhere; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: 12.5px; font-variant-numeric: tabular-nums; margin: 0.3rem 0 0; }
th, td { padding: 0.22rem 0.7rem 0.22rem 0; text-align: right; vertical-align: bottom; } td { white-space: nowrap; }
th.word, td.word { text-align: left; } td.long { white-space: normal; vertical-align: top; }
thead th { border-bottom: 1.5px solid var(--ink); font-weight: 600; line-height: 1.25; }
tbody tr { break-inside: avoid; } tbody td { border-bottom: 1px solid var(--line); }
.verdicts { font-size: 14px; } .verdicts td:first-child { white-space: nowrap; padding-right: 1.5rem; }
math { font-family: "Latin Modern Math", "STIX Two Math", "Cambria Math", "DejaVu Math TeX Gyre", math; }
math[display] { margin: 0.5rem 0; font-size: 1.08em; }
pre { background: var(--tint); border: 1px solid var(--line); border-radius: 4px; padding: 0.7rem 0.9rem;
  font: 12.5px/1.5 ui-monospace, "DejaVu Sans Mono", monospace; white-space: pre-wrap; overflow-wrap: anywhere; }
footer { margin-top: 3rem; color: var(--soft); font-size: 13px; }
@media (max-width: 60rem) { .frame { display: block; padding: 1.5rem 1rem; } nav { display: none; } }
@page { size: A4; margin: 17mm 16mm; }
@media print {
  :root { color-scheme: light; }
  body { font-size: 9.5pt; } .frame { display: block; padding: 0; max-width: none; } nav { display: none; }
  .plate { border: none; padding: 0; } .plate svg { max-height: 170mm; }
  .scroll { overflow: visible; } p { max-width: none; }
  table { font-size: 7pt; } th, td { padding-right: 0.45rem; } .wide table { font-size: 6pt; }
  .verdicts { font-size: 8.5pt; }
  .wide th, .wide td { padding-right: 0.5rem; } pre { font-size: 7.5pt; } figcaption { font-size: 8pt; }
  h1 { font-size: 17pt; } h2 { font-size: 13pt; } h3 { font-size: 11pt; } a { color: inherit; }
}
"""

WIDE = 9
"""Columns from which a table is set smaller in print."""


def page(
    report: Report, summary: Section, sections: Sequence[Section], moments: Sequence[Section], no_maps: str | None
) -> str:
    """The whole page. no_maps: why the moments have no maps, where they have none."""
    first = report.traces[0]
    number = _Numbers()
    parts = [
        _header(report, summary),
        _verdicts(report, sections),
        '<section id="summary"><h2>Accuracy</h2>',
        *(number.shown(one) for one in summary.shown),
        "</section>",
        '<section id="moments"><h2>Moments</h2>',
        f"<p>{_text(report.chosen)} {_text(report.links)}</p>" if moments else "<p>None were chosen.</p>",
        *(_section(one, number, "moment") for one in moments),
        "</section>",
        '<section id="diagnostics"><h2>Diagnostics</h2>',
        *(_section(one, number) for one in sections),
        "</section>",
        '<section id="methods"><h2>Methods</h2>',
        *map(_passage, methods(first, report.checkpoint)),
        '</section><section id="definitions"><h2>What the numbers mean</h2>',
        *map(_passage, definitions(measures.task_of(first), first)),
        "</section>",
        _provenance(report),
        f"<footer><p>Made by Beliefscope {_text(__version__)}. manifest.json has the hash of every file.</p></footer>",
    ]
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{_text(report.title)}</title><style>{STYLE}</style></head>\n"
        f'<body><div class="frame">{_contents(sections, moments)}<main>\n'
        + "\n".join(parts)
        + "\n</main></div></body></html>\n"
    )


class _Numbers:
    """Figures and tables, numbered in the order in which they stand."""

    def __init__(self) -> None:
        self._figures, self._tables = count(1), count(1)

    def shown(self, one: Shown) -> str:
        files = f'<span class="files">{_text(", ".join(one.files))}</span>'
        if one.table is not None:
            caption = f"<figcaption><b>Table {next(self._tables)}.</b> {_text(one.caption)}. {files}</figcaption>"
            wide = " wide" if len(one.table.columns) >= WIDE else ""
            return f'<figure>{caption}<div class="scroll{wide}">{_table(one.table)}</div></figure>'
        figure = next(self._figures)
        caption = f"{_text(one.caption.rstrip('.'))}."
        return (
            f'<figure><div class="plate">{inline(one.svg, f"f{figure}-", one.caption)}</div>'
            f"<figcaption><b>Figure {figure}.</b> {caption} {files}</figcaption></figure>"
        )


def inline(svg: str, prefix: str, label: str) -> str:
    """An SVG file's drawing as part of a page: no prologue, no metadata, ids of its own, and a label."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\bid="', f'id="{prefix}', svg)
    svg = re.sub(r'href="#', f'href="#{prefix}', svg)
    svg = re.sub(r"url\(#", f"url(#{prefix}", svg)
    width = re.search(r'\bwidth="([\d.]+)pt"', svg)
    narrow = f' style="max-width: {float(width[1]) * 1.8:.0f}px"' if width and float(width[1]) < 400.0 else ""
    return svg.replace("<svg", f'<svg role="img" aria-label="{_text(label)}"{narrow}', 1).strip()


def _header(report: Report, summary: Section) -> str:
    first = report.traces[0]
    episodes = ", ".join(str(trace.episode_index) for trace in report.traces)
    steps = sum(map(len, report.traces))
    facts = {
        "Filter": f"{first.filter} ({first.kind.upper()})",
        "Task": first.episode.task,
        "Modalities": ", ".join(first.modalities) or "not told apart",
        "Episodes": f"{episodes} ({steps} steps in all, {first.episode.dt:g} s each)",
        "Sensors": "; ".join(dict.fromkeys(str(trace.faults) or "as they are" for trace in report.traces)),
    }
    if first.particles is not None:
        facts["Particles"] = str(first.particles.shape[1])
    table = next(one.table for one in summary.shown if one.table is not None)
    column = table.columns.index("position (cm)")
    alone = "; ".join(f"{row[0]} {_value(row[column])} cm" for row in reversed(table.rows))
    counted = sum(int(measures.counted(trace).sum()) for trace in report.traces)
    facts["Position RMSE"] = f"{alone} over {counted} counted steps"
    return f"<header><h1>{_text(report.title)}</h1>{_facts(facts)}</header>"


def _facts(facts: dict[str, str]) -> str:
    return "<dl>" + "".join(f"<dt>{_text(name)}</dt><dd>{_text(value)}</dd>" for name, value in facts.items()) + "</dl>"


def _verdicts(report: Report, sections: Sequence[Section]) -> str:
    rows = [
        f'<tr><td class="word long"><a href="#{one.anchor}">{_text(one.title)}</a></td>'
        f'<td class="word long">{_text(one.text)}</td></tr>'
        for one in sections
    ]
    rows += [
        f'<tr><td class="word long soft">{_text(title)}</td><td class="word long soft">Not made: {_text(why)}</td></tr>'
        for title, why in report.refused.items()
    ]
    return (
        '<section id="verdicts"><h2>Verdicts</h2><table class="verdicts"><tbody>'
        + "".join(rows)
        + "</tbody></table></section>"
    )


def _section(section: Section, number: _Numbers, kind: str = "") -> str:
    question = f'<p class="question">{_text(section.question)}</p>' if section.question else ""
    verdict = f'<p class="{"soft" if kind else "verdict"}">{_text(section.text)}</p>'
    link = f'<p><a href="{_text(section.link)}">Open this moment in the dashboard</a></p>' if section.link else ""
    shown = "".join(number.shown(one) for one in section.shown)
    inside = f"<h3>{_text(section.title)}</h3>{question}{verdict}{link}{shown}"
    return f'<article id="{section.anchor}" class="{kind}">{inside}</article>'


def _passage(passage: Passage) -> str:
    # Every second part stands between two dollars.
    inside = (
        mathml(part) if i % 2 else _text(part).replace("\n", " ") for i, part in enumerate(passage.text.split("$"))
    )
    equations = "".join(mathml(one, block=True) for one in passage.equations)
    return f"<h4>{_text(passage.heading)}</h4><p>{''.join(inside)}</p>{equations}"


def _provenance(report: Report) -> str:
    first, checkpoint = report.traces[0], report.checkpoint
    facts = {"Checkpoint": f"SHA-256 {first.checkpoint_hash}"}
    if checkpoint is not None:
        record = checkpoint.record
        if isinstance(checkpoint, Foreign):
            facts["Source"] = checkpoint.source
        for key, name in (("command", "Trained by"), ("data_hash", "Training data")):
            if record.get(key):
                facts[name] = str(record[key])
    seeds = dict.fromkeys(str(trace.seed) for trace in report.traces)
    facts["Seed"] = ", ".join(seeds)
    facts["Versions"] = ", ".join(f"{name} {version}" for name, version in report.versions.items())
    columns = ("episode", "steps", "faults", "SHA-256 of the episode")
    rows = tuple((t.episode_index, len(t), str(t.faults) or "none", t.data_hash) for t in report.traces)
    commands = f"<pre>{_text(chr(10).join(report.commands))}</pre>" if report.commands else ""
    return (
        f'<section id="reproduce"><h2>To make it again</h2>{_facts(facts)}{commands}'
        f'<div class="scroll">{_table(Table("Episodes", columns, rows))}</div></section>'
    )


def _contents(sections: Iterable[Section], moments: Iterable[Section]) -> str:
    def line(anchor: str, title: str, below: Iterable[Section] = ()) -> str:
        inner = "".join(line(one.anchor, one.title) for one in below)
        return f'<li><a href="#{anchor}">{_text(title)}</a>{f"<ol>{inner}</ol>" if inner else ""}</li>'

    lines = [
        line("verdicts", "Verdicts"),
        line("summary", "Accuracy"),
        line("moments", "Moments", moments),
        line("diagnostics", "Diagnostics", sections),
        line("methods", "Methods"),
        line("definitions", "What the numbers mean"),
        line("reproduce", "To make it again"),
    ]
    return f'<nav aria-label="Contents"><ol>{"".join(lines)}</ol></nav>'


def _table(table: Table) -> str:
    """Numbers to the right with three digits, unknown ones as a dash."""
    words = [any(isinstance(row[i], str) for row in table.rows) for i in range(len(table.columns))]

    def cell(tag: str, word: bool, text: str) -> str:
        return f'<{tag} class="{"word" if word else "number"}">{_text(text)}</{tag}>'

    head = "".join(cell("th", word, name.replace("_", " ")) for word, name in zip(words, table.columns, strict=True))
    body = "".join(
        f"<tr>{''.join(cell('td', word, _value(value)) for word, value in zip(words, row, strict=True))}</tr>"
        for row in table.rows
    )
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _value(value: Value) -> str:
    if value is None or (isinstance(value, float) and value != value):
        return "\N{EN DASH}"
    if not isinstance(value, float):
        return str(value)
    shown = f"{value:#.3g}".rstrip(".") if abs(value) < 1000.0 else f"{value:.0f}"
    return shown.replace("-", "\N{MINUS SIGN}")


def _text(text: str) -> str:
    return escape(text, quote=True)
