"""Reports: whole folders or none, true hashes, pages that need nothing else, numbers that evaluation has too."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit
from xml.etree import ElementTree

import numpy as np
import pytest

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, shipped
from beliefscope.filters.evaluate import evaluate
from beliefscope.inspect.likelihood import LikelihoodMap
from beliefscope.inspect.trace import Trace, save_trace, trace
from beliefscope.recordings.report.compose import compose, write_report
from beliefscope.recordings.report.figures import zoom_of
from beliefscope.recordings.report.folder import FORMAT, new_folder
from beliefscope.recordings.report.mathml import mathml
from beliefscope.recordings.report.sections import accuracy, moment_table, worst_moments
from beliefscope.recordings.report.text import definitions, methods

EPISODE = 9
TITLE = 'Doors <script>alert("1")</script> & 40 %'


@pytest.fixture(scope="module")
def checkpoint() -> Checkpoint:
    return load_checkpoint(shipped("door", "crossmodal-ekf"))


@pytest.fixture(scope="module")
def run_(checkpoint: Checkpoint) -> Trace:
    with open_dataset(sample_path("door")) as data:
        return trace(checkpoint, data[EPISODE], EPISODE)


@pytest.fixture(scope="module")
def made(run_: Trace, checkpoint: Checkpoint, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report of one moment with a title that must be escaped."""
    folder = tmp_path_factory.mktemp("reports") / "report"
    link = lambda index, step: f"http://127.0.0.1:8000/?episode={EPISODE}&step={step}"  # noqa: E731
    write_report(compose([run_], checkpoint, title=TITLE, chosen=[(0, 40)], link=link), folder)
    return folder


class Seen(HTMLParser):
    """What a page refers to, and the ids that it has."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.refers: list[tuple[str, str]] = []
        self.ids: list[str] = []
        self.tags: set[str] = set()
        self.feed(text)
        styles = "".join(re.findall(r"<style[^>]*>.*?</style>", text, re.DOTALL))
        self.refers += [("style", one) for one in re.findall(r"@import[^;]*|url\(([^)]*)\)", styles)]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        for name, value in attrs:
            if name in ("href", "src", "xlink:href", "srcset", "data", "action", "poster"):
                self.refers.append((tag, value or ""))
            elif name == "id":
                self.ids.append(value or "")
            elif "url(" in (value or ""):
                self.refers += [(tag, one) for one in re.findall(r"url\(([^)]*)\)", value or "")]


def test_page_needs_nothing_else(made: Path) -> None:
    page = Seen((made / "report.html").read_text())
    assert not page.tags & {"script", "link", "iframe", "object", "embed", "base"}
    assert len(page.ids) == len(set(page.ids))
    outside = [one for one in page.refers if not one[1].startswith(("#", "data:"))]
    assert [tag for tag, _ in outside] == ["a"], "only the moment's link leads out, and only when it is followed"
    assert parse_qs(urlsplit(outside[0][1]).query) == {"episode": [str(EPISODE)], "step": ["40"]}
    assert not {target[1:] for _, target in page.refers if target.startswith("#")} - set(page.ids)
    assert "svg" in page.tags
    assert "math" in page.tags


def test_texts_are_escaped(made: Path) -> None:
    text = (made / "report.html").read_text()
    assert "<script" not in text
    assert "Doors &lt;script&gt;alert(&quot;1&quot;)&lt;/script&gt; &amp; 40 %" in text


def test_manifest_has_the_hash_of_every_file(made: Path, run_: Trace) -> None:
    manifest = json.loads((made / "manifest.json").read_text())
    files = {path.relative_to(made).as_posix(): path for path in made.rglob("*") if path.is_file()}
    del files["manifest.json"]
    assert manifest["files"] == {name: hashlib.sha256(p.read_bytes()).hexdigest() for name, p in files.items()}
    assert manifest["format"] == FORMAT
    assert manifest["checkpoint_hash"] == run_.checkpoint_hash
    assert manifest["traces"][0]["data_hash"] == run_.data_hash
    text = (made / "report.html").read_text()
    shown = set(re.findall(r"(?:figures|tables|data)/[\w.-]+", text))
    assert shown == files.keys() - {"report.html"}, "the page names each file beside what it holds"


def test_same_traces_give_the_same_bytes(made: Path, run_: Trace, checkpoint: Checkpoint, tmp_path: Path) -> None:
    link = lambda index, step: f"http://127.0.0.1:8000/?episode={EPISODE}&step={step}"  # noqa: E731
    again = compose([run_], checkpoint, title=TITLE, chosen=[(0, 40)], link=link)
    document = write_report(again, tmp_path / "again")
    assert document["files"] == json.loads((made / "manifest.json").read_text())["files"]


def test_a_report_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    folder = tmp_path / "report"

    def stopped(there: list[str]) -> None:
        with new_folder(folder) as made:
            (made / "half").write_text("x")
            assert [path.name for path in tmp_path.glob("[!.]*")] == there, "what a kill here would leave"
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stopped([])
    assert not list(tmp_path.iterdir())
    with new_folder(folder) as made:
        (made / "manifest.json").write_text(json.dumps({"format": FORMAT}))
    with pytest.raises(KeyboardInterrupt):
        stopped(["report"])
    assert [path.name for path in tmp_path.iterdir()] == ["report"]
    with new_folder(folder) as made:
        (made / "manifest.json").write_text(json.dumps({"format": FORMAT, "title": "new"}))
    assert [path.name for path in tmp_path.iterdir()] == ["report"], "the older report is replaced"
    assert json.loads((folder / "manifest.json").read_text())["title"] == "new"


def test_what_killed_reports_left_is_cleared_but_not_what_others_write(tmp_path: Path) -> None:
    folder = tmp_path / "report"
    manifest = json.dumps({"format": FORMAT})
    (tmp_path / ".report.k1lled__").mkdir()
    (tmp_path / ".report.k1lled__" / "half").write_text("x")
    (tmp_path / ".report.between_.old").mkdir()  # a kill after the older report was moved away
    (tmp_path / ".report.between_.old" / "manifest.json").write_text(manifest)
    (tmp_path / ".other.k1lled__").mkdir()
    with new_folder(folder) as mine:
        assert sorted(path.name for path in tmp_path.iterdir()) == sorted([".other.k1lled__", mine.name, "report"])
        assert (folder / "manifest.json").read_text() == manifest
        with new_folder(folder) as theirs:
            assert mine.is_dir(), "another process may be writing there"
            (theirs / "manifest.json").write_text(manifest)
        (mine / "manifest.json").write_text(manifest)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".other.k1lled__", "report"]


def test_only_a_report_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "manifest.json").write_text('{"format": "chapters"}')
    with pytest.raises(BadInput, match="something else than a report"), new_folder(tmp_path / "thesis"):
        pass
    assert (tmp_path / "thesis" / "manifest.json").read_text() == '{"format": "chapters"}'


def test_accuracy_is_that_of_evaluate(run_: Trace, checkpoint: Checkpoint) -> None:
    with open_dataset(sample_path("door")) as data:
        expected = evaluate(checkpoint.filter, [data[EPISODE]])
    table = accuracy([run_])
    layer, *numbers = table.rows[-1]
    wanted = [*expected.rmse.values(), expected.nees, expected.coverage95, expected.nll]
    assert layer == "fused"
    np.testing.assert_allclose(np.array(numbers, float), wanted, rtol=1e-4)  # estimates are float32 in SI units


def test_worst_moments_are_the_largest_errors_and_lie_apart(new_trace: Callable[..., Trace]) -> None:
    one = new_trace("ekf", steps=200)
    mean = one.episode.states.copy()
    for step, off in {5: 0.9, 60: 0.3, 65: 0.2, 120: 0.25}.items():  # m in hinge_x
        mean[step, 0] += off
    other = replace(one, estimate_mean=one.episode.states.copy())
    found = worst_moments([other, replace(one, estimate_mean=mean)], 2)
    assert [(m.trace, m.step) for m in found] == [(1, 60), (1, 120)], (
        "not 5, which does not count, nor 65, which is near"
    )


def test_moment_table_has_known_errors(run_: Trace) -> None:
    table = moment_table(run_, 40, None)
    rows = {row[0]: dict(zip(table.columns, row, strict=True)) for row in table.rows}
    off = run_.estimate_mean[40].astype(float) - run_.episode.states[40]
    assert rows["fused"]["hinge_x error (cm)"] == pytest.approx(100 * off[0])
    assert rows["fused"]["position error (cm)"] == pytest.approx(100 * np.hypot(off[0], off[1]))
    shares = [float(rows[name]["acting share (mean)"]) for name in run_.modalities]  # type: ignore[arg-type]
    assert sum(shares) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(("wide", "zoom"), [(0.05, 1), (0.025, 2), (0.01, 4), (0.004, 6)])
def test_a_map_is_drawn_as_near_as_holds_what_it_says(
    new_trace: Callable[..., Trace], new_map: Callable[..., LikelihoodMap], wide: float, zoom: int
) -> None:
    flat = new_map(new_trace("ekf"), 0, 135)
    x, y = np.meshgrid(flat.offsets_x, flat.offsets_y)
    round_ = np.repeat((-0.5 * (x**2 + y**2) / wide**2)[None], 3, axis=0)
    assert zoom_of(replace(flat, log_likelihood=round_)) == zoom


@pytest.mark.parametrize("kind", ["ekf", "ukf", "pf", "lstm", "foreign"])
@pytest.mark.parametrize("weighed", [True, False])
def test_every_equation_can_be_drawn(new_trace: Callable[..., Trace], kind: str, weighed: bool) -> None:
    one = new_trace("pf" if kind == "pf" else "ekf")
    one = replace(one, kind=kind, **({} if weighed else {"weights": None, "acting": None}))
    passages = [*methods(one, None), *definitions(find_task("door"), one)]
    maths = [part for p in passages for part in (*p.equations, *p.text.split("$")[1::2])]
    for tex in maths:
        drawn = re.sub(r"&(?!(?:lt|gt|amp|#\d+);)(\w+);", r"\1", mathml(tex, block=True))
        assert ElementTree.fromstring(drawn).tag == "math"
    assert all(p.text.count("$") % 2 == 0 for p in passages)
    fusion = " ".join(e for p in passages for e in p.equations)
    assert (r"\beta_k" in fusion) == (weighed and kind in ("ekf", "ukf", "pf"))


@pytest.mark.parametrize("tex", [r"\nosuch", "{a", "a}", "_a", "a_b_c"])
def test_mathematics_that_is_not_ours_is_refused(tex: str) -> None:
    with pytest.raises(ValueError, match=r"not known|missing|closes|could stand"):
        mathml(tex)


def test_without_a_checkpoint_it_says_what_is_missing(new_trace: Callable[..., Trace], tmp_path: Path) -> None:
    one = new_trace("ekf", steps=80)
    document = write_report(compose([one], None, chosen=[(0, 50)]), tmp_path / "report")
    text = (tmp_path / "report" / "report.html").read_text()
    assert "No maps: the filter&#x27;s checkpoint is not at hand." in text
    assert set(document["not_made"]) >= {"Likelihood maps"}
    assert set(document["diagnostics"]) >= {"consistency", "weights"}


def test_command_links_its_moments(run: Any, run_: Trace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    save_trace(run_, tmp_path / "run.trace")
    code, out, _ = run("report run.trace --moment 9:40 --url http://localhost:9000 --json -")
    assert code == 0
    document = json.loads(out)
    links = [parse_qs(urlsplit(moment["link"]).query) for moment in document["moments"]]
    assert [link["step"] for link in links] == [["40"]]
    assert {link["data"][0] for link in links} == {"sample"}
    assert document["moments"][0]["link"].startswith("http://localhost:9000/?task=door&filter=crossmodal-ekf")
    assert document["traces"][0]["sha256"] == hashlib.sha256((tmp_path / "run.trace").read_bytes()).hexdigest()
    assert "beliefscope trace door --filter crossmodal-ekf --episode 9 --seed 0 -o run.trace" in document["commands"]
    assert (tmp_path / "report" / "report.html").is_file()
