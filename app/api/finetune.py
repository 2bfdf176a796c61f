"""Fine-tuning over HTTP (docs/api.md): what can be trained, the run as a job, what it changed, what becomes of it."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Body, HTTPException
from pydantic import TypeAdapter

from beliefscope.app.cli.commands.finetune import curves, errors, of
from beliefscope.app.jobs.queue import UNDER_WAY, Job, Jobs
from beliefscope.app.jobs.worker import Report
from beliefscope.app.protocol.permalinks import beside, moment_link
from beliefscope.app.runs import kept_filters
from beliefscope.app.runs.kept_filters import Child
from beliefscope.app.runs.trace_store import Library, Settings
from beliefscope.app.workspace.json_files import content, read_record
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from beliefscope.filters.external.load import Foreign
from beliefscope.filters.finetuning.finetune import FineTune, finetune
from beliefscope.filters.finetuning.loop import Look
from beliefscope.filters.finetuning.module_selection import chosen, moved, presets, tree, within
from beliefscope.filters.finetuning.slices import slices_of
from beliefscope.inspect.compare.checkpoints import Change, change_of
from beliefscope.inspect.compare.effects import Worsening
from beliefscope.inspect.diagnostics.base import as_json

KIND = "finetune"
TUNING = 0.8
"""Share of a job that is training; the rest is holding the child against its parent."""

PAUSE = 0.3  # s between two writings of how a run goes


@dataclass(frozen=True)
class Run:
    """What was asked for, as ``run.json`` has it. run: its name and its folder's. asked: s since 1970."""

    run: str
    task: str
    filter: str
    data: str
    settings: dict[str, Any]
    asked: float


RUN = TypeAdapter(Run)

Act = Literal["accept", "keep", "roll-back"]


def routes(library: Library, jobs: Jobs) -> APIRouter:
    """Every route under ``/api/finetune`` and ``/api/tuned``."""
    router = APIRouter()

    @router.get("/api/finetune/{task}/{filter}")
    def offer(task: str, filter: str) -> dict[str, Any]:
        checkpoint = library.checkpoint(task, filter)
        runs = [shown for run in _runs(library) if run["task"] == task and (shown := _shown(library, jobs, run))]
        return {**offered(checkpoint), "runs": runs}

    @router.post("/api/finetune/{task}/{filter}", status_code=202)
    def start(task: str, filter: str, settings: Annotated[dict[str, Any], Body()], data: str = "") -> dict[str, Any]:
        checkpoint = library.checkpoint(task, filter)
        asked = FineTune.of(settings)
        chosen(checkpoint.filter, asked.train, asked.freeze)
        for one, _ in asked.mix:
            one.check(checkpoint.task, checkpoint.filter.names)
        name, _ = library.dataset(task, data)
        known = (checkpoint.hash, library.data_hash(task, name), asked.to_json(), library.settings.particles)
        run = hashlib.sha256(json.dumps([filter, name, *known], sort_keys=True).encode()).hexdigest()[:16]
        folder = _folder(library, run)
        folder.mkdir(parents=True, exist_ok=True)
        about = {"run": run, "task": task, "filter": filter, "data": name, "settings": asked.to_json()}
        write_atomically(folder / "run.json", json.dumps(about | {"asked": time.time()}).encode())
        link = "?" + urlencode({"task": task, "filter": filter, "data": name, "tab": "finetune", "run": run})
        arguments = about | {"server": library.settings.to_json(), "folder": str(folder)}
        what = " and ".join(one.name for one, _ in asked.mix) or "nominal data"
        jobs.submit(KIND, f"Fine-tuning of {filter}, {task}: {what}", arguments, run, link)
        return _shown(library, jobs, about)

    @router.get("/api/tuned/{run}")
    def how(run: str) -> dict[str, Any]:
        about = _known(library, run)
        shown, folder = _shown(library, jobs, about), _folder(library, run)
        # Not the job's own result: a child that is kept outlasts its job.
        found = _read(folder / "found.json") if shown["child"] else None
        return shown | {"progress": _read(folder / "progress.json"), "found": found}

    @router.post("/api/tuned/{run}/{act}")
    def decide(run: str, act: Act) -> dict[str, Any]:
        about = _known(library, run)
        job = jobs.find(KIND, run)
        path = _folder(library, run) / "child.safetensors"
        if (job is not None and job.state in UNDER_WAY) or not path.is_file():
            raise HTTPException(409, f"Run {run!r} has no child yet to {act.replace('-', ' ')}.")
        name = _name(about, path)
        if act == "roll-back":
            kept_filters.drop(library, about["task"], name)
        else:
            kept_filters.keep(library, Child(about["task"], name, str(path), act == "accept"))
        return _shown(library, jobs, about)

    return router


def offered(checkpoint: Checkpoint) -> dict[str, Any]:
    """What of a filter can be trained, and on what; ``why_not`` where nothing can."""
    if isinstance(checkpoint, Foreign):
        why = "a filter from outside is not trained here"
        return {"why_not": why, "modules": [], "presets": [], "slices": [], "settings": FineTune().to_json()}
    filter_, known = checkpoint.filter, presets(checkpoint.filter)
    trained = {name: set(chosen(filter_, [name])) for name in known}
    slices = [one for one in slices_of(checkpoint.task) if all(name in filter_.names for name in one.only)]
    ran = checkpoint.record.get("parts", {})  # of the fine-tuning that made it
    modules = [
        {"name": n.name, "kind": n.kind, "says": n.says, "parameters": n.parameters, "depth": n.depth}
        | (moved(n.name, ran) if any(within(key, n.name) for key in ran) else {})
        for n in tree(filter_)
        if n.name and n.parameters
    ]
    parameters = [name for name, _ in filter_.named_parameters()]
    return {
        "why_not": None,
        "modules": modules,
        "presets": [{"name": n, "trains": [p for p in parameters if p in trained[n]]} for n in known],
        "slices": [one.to_json() | {"text": str(one)} for one in slices if one.name != "nominal"],
        "settings": FineTune().to_json(),
    }


def work(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """The job: trains, or goes on where it was stopped; then holds the child against its parent."""
    settings, asked = Settings.of_json(arguments["server"]), FineTune.of(arguments["settings"])
    task, name, folder = arguments["task"], arguments["filter"], Path(arguments["folder"])
    library = Library(settings)
    try:
        parent = library.checkpoint(task, name)
        data_name, data = library.dataset(task, arguments["data"])
        data_hash = library.data_hash(task, data_name)
        path = folder / "child.safetensors"
        with curves(folder / "log") as write:
            diary = Diary(folder, asked.steps)

            def looked(found: Look) -> None:
                diary.look(found)
                values = {f"{s}/{key}": value for s, said in found.slices.items() for key, value in of(said)}
                write(found.step, values | ({} if found.loss is None else {"loss": found.loss}))

            def stepped(step: int, steps: int, loss: float) -> None:
                diary.step(step, loss)
                report(TUNING * step / steps, f"step {step} of {steps}, loss {loss:.3g}; {diary.errors}")

            tuned = finetune(
                parent,
                list(data),
                data_hash=data_hash,
                settings=asked,
                command=f"fine-tuned on the page from {name}",
                report=stepped,
                looked=looked,
                resumed=diary.resume,
                partial=folder / "child.partial",
            )
            diary.write()
        assert tuned is not None, "nobody asked to stop"
        save_checkpoint(tuned.filter, parent.name, tuned.record, path)
        child = load_checkpoint(path)
        found = change_of(
            parent,
            child,
            data,
            slices=[one for one, _ in asked.mix],
            particles=settings.particles,
            seed=settings.seed,
            progress=lambda share: report(TUNING + (1.0 - TUNING) * share, "holding the child against its parent"),
        )
    finally:
        library.close()
    document: dict[str, Any] = as_json(_document(found, child, arguments, data_name))
    write_atomically(folder / "found.json", json.dumps(document, allow_nan=False).encode())
    return {"verdict": found.verdict}


def _document(found: Change, child: Checkpoint, about: Mapping[str, Any], data: str) -> dict[str, Any]:
    """What the page shows of a child: the report of its change, its moments as links that show the parent beside it."""
    name = _called(about["filter"], child.hash)
    views = found.views()
    moments = found.table_of(found.moments).title
    record, weighed = child.record, child.filter.architecture.fusion == "crossmodal"

    def link(m: Worsening) -> str:
        return moment_link(child.task, name, data, m.episode, m.step, m.faults)

    return {
        "child": {"name": name, "hash": child.hash} | {key: record[key] for key in ("best_step", "steps", "seconds")},
        "change": views | {"tables": [one for one in views["tables"] if one["title"] != moments]},
        "frozen": found.frozen,
        "moments": [as_json(m) | {"link": beside(link(m), m, about["filter"], weighed)} for m in found.moments],
    }


class Diary:
    """How a run goes, in a file that the server reads: the loss of each step, and all looks."""

    def __init__(self, folder: Path, steps: int) -> None:
        self._path, self._steps, self._written = folder / "progress.json", steps, 0.0
        self._before = (_read(self._path) or {}).get("losses", [])  # of a run that was stopped
        self._losses: list[tuple[int, float]] = []
        self._looks: list[Look] = []

    @property
    def errors(self) -> str:
        return errors(self._looks[0], self._looks[-1]) if self._looks else ""

    def resume(self, step: int) -> None:
        """The run goes on after this step."""
        self._losses = [(at, loss) for at, loss in self._before if at <= step]

    def look(self, found: Look) -> None:
        self._looks.append(found)
        self.write()

    def step(self, step: int, loss: float) -> None:
        self._losses.append((step, loss))
        if time.monotonic() - self._written > PAUSE:
            self.write()

    def write(self) -> None:
        self._written = time.monotonic()
        said = {"steps": self._steps, "losses": self._losses, "looks": self._looks}
        write_atomically(self._path, json.dumps(as_json(said)).encode())


def _folder(library: Library, run: str) -> Path:
    return library.settings.workspace / "finetune" / run


def _runs(library: Library) -> list[dict[str, Any]]:
    """All that were asked for in this workspace, the newest first."""
    found = []
    for path in (library.settings.workspace / "finetune").glob("*/run.json"):
        with suppress(OSError, ValueError):  # no run of ours
            run = read_record(RUN, path)
            if run.run == path.parent.name:
                found.append(asdict(run))
    return sorted(found, key=lambda run: -run["asked"])


def _known(library: Library, run: str) -> dict[str, Any]:
    for one in _runs(library):
        if one["run"] == run:
            return one
    raise HTTPException(404, f"Run {run!r} does not exist.")


def _shown(library: Library, jobs: Jobs, about: Mapping[str, Any]) -> dict[str, Any]:
    """A run as it is now: its job, its child's name, and what became of that: ``kept``, ``default`` or nothing yet."""
    job: Job | None = jobs.find(KIND, about["run"])
    path = _folder(library, about["run"]) / "child.safetensors"
    done = path.is_file() and (job is None or job.state not in UNDER_WAY)
    name = _name(about, path) if done else None
    kept = {one.name: one for one in kept_filters.read(library.settings.workspace) if one.task == about["task"]}
    place = None if name not in kept else "default" if kept[name].default else "kept"
    return {**about, "job": None if job is None else asdict(job), "child": name, "place": place}


def _read(path: Path) -> dict[str, Any] | None:
    """JSON; None where it is not there."""
    with suppress(OSError, ValueError):
        found: dict[str, Any] = read_json(content(path))
        return found if isinstance(found, dict) else None
    return None


def _name(about: Mapping[str, Any], path: Path) -> str:
    return _called(about["filter"], hashlib.sha256(path.read_bytes()).hexdigest())


def _called(parent: str, hash: str) -> str:
    """A child's name on the shelf: its parent's, less the digits of that one's own, and the first of its hash."""
    base, dash, digits = parent.rpartition("-")
    family = base if dash and len(digits) == 6 and set(digits) <= set("0123456789abcdef") else parent
    return f"{family}-{hash[:6]}"
