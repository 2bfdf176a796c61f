"""Reports: atomic folders, hashes, self-contained pages, and numbers that equal those of evaluate."""

from __future__ import annotations

import hashlib
import io
import json
import re
import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit
from xml.etree import ElementTree

import numpy as np
import pytest

from beliefscope.app.cli.main import main
from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path
from beliefscope.filters.evaluate import evaluate
from beliefscope.inspect.diagnosis.diagnose import diagnose
from beliefscope.inspect.maps.map_engine import LikelihoodMap
from beliefscope.inspect.slices.report import slices_of
from beliefscope.inspect.standalone import standalone_runs
from beliefscope.inspect.trace import Trace, save_trace, trace
from beliefscope.inspect.traces.batch import trace_all
from beliefscope.recordings.report.compose import compose, scene_caption, write_report
from beliefscope.recordings.report.diagnosis import report_diagnosis
from beliefscope.recordings.report.figures import zoom_of
from beliefscope.recordings.report.folder import FORMAT, new_folder
from beliefscope.recordings.report.page import _code, mathml
from beliefscope.recordings.report.sections import accuracy, event_table, worst_events
from beliefscope.recordings.report.text import definitions, methods

pytestmark = pytest.mark.slow

EPISODE = 9
URL = "http://localhost:9000"
TITLE = 'Doors <script>alert("1")</script> & 40 %'


@pytest.fixture(scope="module")
def checkpoint() -> Checkpoint:
    return load_checkpoint(pretrained_path("door", "crossmodal-ekf"))


@pytest.fixture(scope="module")
def run_(checkpoint: Checkpoint) -> Trace:
    with open_dataset(sample_path("door")) as data:
        return trace(checkpoint, data[EPISODE], EPISODE)


def write_by_command(folder: Path, run_: Trace) -> Any:
    """Writes a report of one event with a title that must be escaped; returns the printed document."""
    save_trace(run_, folder / "run.trace")
    words = ["report", "run.trace", "--event", f"{EPISODE}:40", "--title", TITLE, "--url", URL, "--json", "-"]
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()) as out:
        patch.chdir(folder)
        patch.setattr(sys, "argv", ["beliefscope", *words])
        with pytest.raises(SystemExit) as end:
            main()
    assert not end.value.code
    return json.loads(out.getvalue())


@pytest.fixture(scope="module")
def printed(run_: Trace, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    """The folder in which the command wrote a report, and the printed document."""
    folder = tmp_path_factory.mktemp("reports")
    return folder, write_by_command(folder, run_)


@pytest.fixture(scope="module")
def report(printed: tuple[Path, Any]) -> Path:
    return printed[0] / "report"


class PageParser(HTMLParser):
    """References, ids and tags of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.references: list[tuple[str, str]] = []
        self.ids: list[str] = []
        self.tags: set[str] = set()
        self.feed(text)
        styles = "".join(re.findall(r"<style[^>]*>.*?</style>", text, re.DOTALL))
        self.references += [("style", url) for url in re.findall(r"@import[^;]*|url\(([^)]*)\)", styles)]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        for name, value in attrs:
            if name in ("href", "src", "xlink:href", "srcset", "data", "action", "poster"):
                self.references.append((tag, value or ""))
            elif name == "id":
                self.ids.append(value or "")
            elif "url(" in (value or ""):
                self.references += [(tag, url) for url in re.findall(r"url\(([^)]*)\)", value or "")]


def test_page_is_self_contained(report: Path) -> None:
    page = PageParser((report / "report.html").read_text())
    assert not page.tags & {"script", "link", "iframe", "object", "embed", "base"}
    assert len(page.ids) == len(set(page.ids))
    external = [reference for reference in page.references if not reference[1].startswith(("#", "data:"))]
    assert [tag for tag, _ in external] == ["a"], "the only external reference is the permalink"
    query = parse_qs(urlsplit(external[0][1]).query)
    assert (query["episode"], query["step"]) == ([str(EPISODE)], ["40"])
    assert not {target[1:] for _, target in page.references if target.startswith("#")} - set(page.ids)
    assert "svg" in page.tags
    assert "math" in page.tags


def test_the_fused_estimate_comes_first(report: Path) -> None:
    text = re.sub("<[^>]*>", " ", (report / "report.html").read_text())
    names = "fused .* image-only update .* haptics-only update .* image standalone .* haptics standalone"
    assert re.search(rf"Position RMSE\s+{names} .* counted steps", text)
    assert "Shaded: contact; dotted: the events below." in text


def test_texts_are_escaped(report: Path) -> None:
    text = (report / "report.html").read_text()
    assert "<script" not in text
    assert "Doors &lt;script&gt;alert(&#34;1&#34;)&lt;/script&gt; &amp; 40 %" in text


def test_manifest_has_the_hash_of_every_file(report: Path, run_: Trace) -> None:
    manifest = json.loads((report / "manifest.json").read_text())
    files = {path.relative_to(report).as_posix(): path for path in report.rglob("*") if path.is_file()}
    del files["manifest.json"]
    assert manifest["files"] == {name: hashlib.sha256(p.read_bytes()).hexdigest() for name, p in files.items()}
    assert manifest["format"] == FORMAT
    assert manifest["checkpoint_hash"] == run_.checkpoint_hash
    assert manifest["traces"][0]["data_hash"] == run_.data_hash
    text = (report / "report.html").read_text()
    names = set(re.findall(r"(?:figures|tables|data)/[\w.-]+", text))
    assert names == files.keys() - {"report.html"}, "the page names every file"


@pytest.mark.long
def test_same_traces_give_the_same_bytes(report: Path, run_: Trace, tmp_path: Path) -> None:
    write_by_command(tmp_path, run_)
    again, first = (json.loads((folder / "manifest.json").read_text()) for folder in (tmp_path / "report", report))
    assert again["files"] == first["files"]


def test_folder_is_written_atomically(tmp_path: Path) -> None:
    folder = tmp_path / "report"

    def interrupt(visible: list[str]) -> None:
        with new_folder(folder) as target:
            (target / "partial").write_text("x")
            assert [path.name for path in tmp_path.glob("[!.]*")] == visible
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupt([])
    assert not list(tmp_path.iterdir())
    with new_folder(folder) as target:
        (target / "manifest.json").write_text(json.dumps({"format": FORMAT}))
    with pytest.raises(KeyboardInterrupt):
        interrupt(["report"])
    assert [path.name for path in tmp_path.iterdir()] == ["report"]
    with new_folder(folder) as target:
        (target / "manifest.json").write_text(json.dumps({"format": FORMAT, "title": "new"}))
    assert [path.name for path in tmp_path.iterdir()] == ["report"], "the existing report is replaced"
    assert json.loads((folder / "manifest.json").read_text())["title"] == "new"


def test_folders_of_killed_processes_are_removed(tmp_path: Path) -> None:
    folder = tmp_path / "report"
    manifest = json.dumps({"format": FORMAT})
    (tmp_path / ".report.k1lled__").mkdir()
    (tmp_path / ".report.k1lled__" / "partial").write_text("x")
    (tmp_path / ".report.between_.old").mkdir()  # killed after moving the existing report away
    (tmp_path / ".report.between_.old" / "manifest.json").write_text(manifest)
    (tmp_path / ".other.k1lled__").mkdir()
    with new_folder(folder) as first:
        assert sorted(path.name for path in tmp_path.iterdir()) == sorted([".other.k1lled__", first.name, "report"])
        assert (folder / "manifest.json").read_text() == manifest
        with new_folder(folder) as second:
            assert first.is_dir(), "folders in use are kept"
            (second / "manifest.json").write_text(manifest)
        (first / "manifest.json").write_text(manifest)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".other.k1lled__", "report"]


def test_other_folders_are_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "manifest.json").write_text('{"format": "chapters"}')
    with pytest.raises(BadInput, match="something other than a report"), new_folder(tmp_path / "thesis"):
        pass
    assert (tmp_path / "thesis" / "manifest.json").read_text() == '{"format": "chapters"}'


def test_accuracy_equals_evaluate(run_: Trace, checkpoint: Checkpoint) -> None:
    with open_dataset(sample_path("door")) as data:
        expected = evaluate(checkpoint.filter, [data[EPISODE]], modalities=True)
    metrics = {f"{name}-only update": result for name, result in expected.updates.items()} | {"fused": expected}
    metrics |= {f"{name} standalone": result for name, result in expected.standalone.items()}
    rows = accuracy([run_], standalone_runs([run_], checkpoint)).rows
    assert [row[0] for row in rows] == list(metrics)
    for (_, *numbers), result in zip(rows, metrics.values(), strict=True):
        reference = [*result.rmse.values(), result.nees, result.coverage95, result.nll]
        np.testing.assert_allclose(np.array(numbers, float), reference, rtol=1e-4)  # estimates are float32 in SI units


def test_worst_events_are_the_largest_errors_with_a_minimum_distance(new_trace: Callable[..., Trace]) -> None:
    trace_ = new_trace("ekf", steps=200)
    mean = trace_.episode.states.copy()
    for step, error in {5: 0.9, 60: 0.3, 65: 0.2, 120: 0.25}.items():  # m in hinge_x
        mean[step, 0] += error
    exact = replace(trace_, estimate_mean=trace_.episode.states.copy())
    events = worst_events([exact, replace(trace_, estimate_mean=mean)], 2)
    assert [(e.trace, e.step) for e in events] == [(1, 60), (1, 120)], "5 is not counted, 65 is too close to 60"


def test_event_table_has_known_errors(run_: Trace) -> None:
    table = event_table(run_, 40, None)
    rows = {row[0]: dict(zip(table.columns, row, strict=True)) for row in table.rows}
    error = run_.estimate_mean[40].astype(float) - run_.episode.states[40]
    assert rows["fused"]["hinge x error (cm)"] == pytest.approx(100 * error[0])
    assert rows["fused"]["position error (cm)"] == pytest.approx(100 * np.hypot(error[0], error[1]))
    shares = [float(rows[f"{name}-only update"]["effective weight (mean)"]) for name in run_.modalities]  # type: ignore[arg-type]
    assert sum(shares) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(("width", "zoom"), [(0.05, 1), (0.025, 2), (0.01, 4), (0.004, 6)])
def test_zoom_contains_the_likelihood(
    new_trace: Callable[..., Trace], new_map: Callable[..., LikelihoodMap], width: float, zoom: int
) -> None:
    flat = new_map(new_trace("ekf"), 0, 135)
    x, y = np.meshgrid(flat.offsets_x, flat.offsets_y)
    gaussian = np.repeat((-0.5 * (x**2 + y**2) / width**2)[None], 3, axis=0)
    assert zoom_of(replace(flat, log_likelihood=gaussian)) == zoom


@pytest.mark.parametrize("kind", ["ekf", "ukf", "pf", "lstm", "external"])
@pytest.mark.parametrize("weighted", [True, False])
def test_every_equation_is_converted(new_trace: Callable[..., Trace], kind: str, weighted: bool) -> None:
    trace_ = new_trace("pf" if kind == "pf" else "ekf")
    trace_ = replace(trace_, kind=kind, **({} if weighted else {"weights": None, "effective_weights": None}))
    passages = [*methods(trace_, None), *definitions(find_task("door"), trace_)]
    equations = [part for p in passages for part in (*p.equations, *p.text.split("$")[1::2])]
    for tex in equations:
        element = ElementTree.fromstring(mathml(tex, "block"))
        assert element.tag.endswith("math")
        assert "\\" not in "".join(element.itertext()), "an unknown command"
    assert all(p.text.count("$") % 2 == 0 for p in passages)
    fusion = " ".join(e for p in passages for e in p.equations)
    assert (r"\beta_k" in fusion) == (weighted and kind in ("ekf", "ukf", "pf"))


@pytest.mark.parametrize("kind", ["ekf", "pf"])
def test_information_filters_are_described(new_trace: Callable[..., Trace], kind: str) -> None:
    checkpoint = Checkpoint(build(architecture("door", f"information-{kind}")), "f", "0" * 64, {})
    passage = next(p for p in methods(new_trace(kind), checkpoint) if "usion" in p.heading)
    assert "$p_k = K \\beta_k$" in passage.text
    for tex in (*passage.equations, *passage.text.split("$")[1::2]):
        assert "\\" not in "".join(ElementTree.fromstring(mathml(tex, "block")).itertext())
    assert (r"\prod_k" in passage.equations[0]) == (kind == "pf")


@pytest.mark.long
def test_captions_of_scenes_name_what_is_drawn(run_: Trace) -> None:
    contact = run_.episode.contact.astype(bool)
    touching, free = int(contact.argmax()), int(contact.argmin())
    assert contact[touching] and not contact[free]  # noqa: PT018
    assert "Arrow: force on the end effector" in scene_caption(run_, touching, True)
    assert "Arrow" not in scene_caption(run_, free, True)
    assert "object at its true state (solid)" in scene_caption(run_, free, True)
    plain = replace(run_, episode=replace(run_.episode, task=replace(run_.task, outline=None)))
    assert "the true and the estimated position. Right" in scene_caption(plain, free, True)


@pytest.mark.long
def test_without_checkpoint_there_are_no_maps(new_trace: Callable[..., Trace], tmp_path: Path) -> None:
    content = compose([new_trace("ekf", steps=80)], None, steps=[(0, 50)])
    assert set(content.results) >= {"consistency", "weights"}
    few = {name: content.results[name] for name in ("consistency", "weights")}  # figures take long to draw
    document = write_report(replace(content, results=few), tmp_path / "report")
    text = (tmp_path / "report" / "report.html").read_text()
    assert "No maps: the filter&#39;s checkpoint is not available." in text
    assert '<p class="verdict">Not available: the filter&#39;s checkpoint is not available.</p>' in text
    assert document["diagnosis"] is None
    assert set(document["not_made"]) >= {"Likelihood maps"}
    assert set(document["diagnostics"]) == {"consistency", "weights"}


def test_a_fine_tuned_filter_is_called_so(run_: Trace, checkpoint: Checkpoint, tmp_path: Path) -> None:
    record = dict(checkpoint.record) | {"base": {"name": checkpoint.name, "hash": "0123456789abcdef"}}
    content = replace(compose([run_], checkpoint, steps=[]), checkpoint=replace(checkpoint, record=record), results={})
    write_report(content, tmp_path / "report")
    text = (tmp_path / "report" / "report.html").read_text()
    assert f"{checkpoint.name} (EKF), fine-tuned from checkpoint 0123456789ab" in text


def test_the_diagnosis_is_that_of_the_traces_and_links_to_its_moment(checkpoint: Checkpoint) -> None:
    faults = Faults.parse("image_frozen=5")
    with open_dataset(sample_path("door")) as data:
        frozen = trace(checkpoint, data[EPISODE], EPISODE, faults=faults)
        expected = diagnose(checkpoint, {EPISODE: faults.apply(data[EPISODE], 0)})
    link: Callable[[int, int], str] = "{}:{}".format
    result = report_diagnosis([frozen], checkpoint, None, link, lambda share: None)
    assert result.result is not None
    assert result.result.headline == expected.headline
    assert result.link == "0:6"
    edited = replace(frozen, settings={**frozen.settings, "edits": [{"from": 0, "to": 5}]})
    for traces, reason in (([edited], "interventions"), ([frozen, frozen], "several traces")):
        refused = report_diagnosis(traces, checkpoint, None, link, lambda share: None)
        assert refused.result is None
        assert reason in refused.reason


def test_the_diagnosis_comes_first(report: Path) -> None:
    text = (report / "report.html").read_text()
    headline = json.loads((report / "manifest.json").read_text())["diagnosis"]
    assert headline.startswith("Healthy")
    assert text.index("<h2>Diagnosis</h2>") < text.index(headline) < text.index("<h2>Verdicts</h2>")


def test_commands_are_code() -> None:
    assert _code("Train: `a <b>`.") == "Train: <code>a &lt;b&gt;</code>."


def test_command_adds_permalinks(printed: tuple[Path, Any]) -> None:
    folder, document = printed
    links = [parse_qs(urlsplit(event["link"]).query) for event in document["events"]]
    assert [link["step"] for link in links] == [["40"]]
    assert {link["data"][0] for link in links} == {"sample"}
    assert document["events"][0]["link"].startswith(f"{URL}/?task=door&filter=crossmodal-ekf")
    assert document["traces"][0]["sha256"] == hashlib.sha256((folder / "run.trace").read_bytes()).hexdigest()
    assert "beliefscope trace door --filter crossmodal-ekf --episode 9 --seed 0 -o run.trace" in document["commands"]
    assert (folder / "report" / "report.html").is_file()


@pytest.mark.long
def test_slices_are_searched_in_enough_episodes() -> None:
    filter_ = load_checkpoint(pretrained_path("push-field", "information-ekf"))
    with open_dataset(sample_path("push-field")) as data:
        traces = list(trace_all(filter_, data, data.held_out()[:8]))
    slices = compose(traces, filter_).results["slices"]
    assert slices == slices_of(traces)
    assert slices.tables()[0].rows
    fewer = compose(traces[:1], filter_)
    assert "slices" not in fewer.results
    assert fewer.reasons["Slices"] == "1 episode; a search for slices needs at least 8"
