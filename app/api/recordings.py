"""Recordings over HTTP (docs/api.md): of the runs that are shown, and from elsewhere; listed and looked after."""

from __future__ import annotations

import asyncio
import hashlib
import threading
import time
from collections.abc import AsyncIterator, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import quote

from fastapi import APIRouter, HTTPException, Request
from fastapi.responses import FileResponse, Response
from pydantic import BaseModel, ConfigDict, Field
from starlette.requests import ClientDisconnect

from beliefscope import __version__
from beliefscope.app.jobs.queue import Job, Jobs
from beliefscope.app.jobs.worker import Report
from beliefscope.app.protocol.etag import tagged_json
from beliefscope.app.protocol.permalinks import moment_link
from beliefscope.app.runs.live_runs import PREFIX, name_of
from beliefscope.app.runs.trace_store import Library, Selection, Settings, Traced
from beliefscope.app.server.security import READ_ONLY
from beliefscope.app.workspace.recording_probe import About
from beliefscope.app.workspace.recordings import ENDING, Recording, RrdFiles, disk
from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.inspect.catalog import quick
from beliefscope.inspect.likelihood import LikelihoodMap
from beliefscope.inspect.traces.live_file import SUFFIX, GrowingWriter

LARGEST = 2 * 10**9  # bytes of a file that is added
SPARED = 2 * 10**8  # bytes of the disk that adding files leaves free
LOOK = 1 << 24  # bytes of it that come between two looks at what is still free
MAGIC = b"RRF"  # what Rerun's files begin with, of any version
FREE_IN = 10**7  # bytes to which the free space is told, so that a list does not change all the time


class RecordingRequest(BaseModel):
    """Body of ``POST /api/recordings``; maps at every ``maps``-th step, none for 0. Automatic: only to be looked at."""

    model_config = ConfigDict(extra="forbid", strict=True)
    task: str
    filter: str
    episode: int
    faults: str = ""
    data: str = ""
    maps: Annotated[int, Field(ge=0)] = 0
    automatic: bool = False


class ChangeRequest(BaseModel):
    """Body of ``PATCH /api/recordings/{name}.rrd``: what is to be another. Automatic: false, it is to be kept."""

    model_config = ConfigDict(extra="forbid", strict=True)
    name: str | None = None
    tags: list[str] | None = None
    automatic: Literal[False] | None = None


def routes(library: Library, files: RrdFiles, jobs: Jobs) -> APIRouter:
    """Every route under ``/api/recordings``."""
    drawer = ThreadPoolExecutor(1, "drawing recordings")  # matplotlib keeps the fonts of each thread that draws open

    @asynccontextmanager
    async def lifespan(_: Any) -> AsyncIterator[None]:
        yield
        await asyncio.to_thread(drawer.shutdown, cancel_futures=True)

    router = APIRouter(lifespan=lifespan)
    writing = threading.Lock()
    runs = Runs(library)

    @router.get("/api/recordings")
    def list_recordings(request: Request) -> Response:
        found, trash = files.all(), files.deleted()
        tasks = runs.tasks()
        free = disk(files.folder) // FREE_IN * FREE_IN
        shown = {
            "recordings": [_shown(one, *runs.of(one.about, tasks)) for one in found],
            "deleted": [asdict(one) for one in trash],
            "bytes": sum(one.bytes for one in found),
            "free": free,
            "largest": max(0, min(LARGEST, free - SPARED)),
        }
        return tagged_json(request, shown)

    @router.post("/api/recordings", status_code=201)
    def record(wanted: RecordingRequest, request: Request, response: Response) -> dict[str, Any]:
        started = time.perf_counter()
        of = Selection(wanted.task, wanted.filter, wanted.episode, Faults.parse(wanted.faults), wanted.data)
        traced = library.traced(of)
        # A job makes the maps. Of a run that goes on it would find more steps than were asked for.
        maps = 0 if traced.grows or traced.no_maps else wanted.maps
        # The name says all that the file depends on, so one that was made under it is this one.
        depends = f"{traced.key} maps {maps} diagnostics version {__version__}"
        parts = hashlib.sha256(depends.encode()).hexdigest()[:8]
        made_as = f"{of.stem}-{parts}{ENDING}"
        with writing:
            there = files.made_as(made_as)
            if there is None and request.app.state.read_only:
                raise HTTPException(403, f"{READ_ONLY} No recording of this run was written before.")
            path = there
            if path is None and not maps:
                path = drawer.submit(_written, files, traced, made_as, wanted.automatic).result()
        if path is None:
            response.status_code = 202
            target = files.unused(made_as)
            arguments = {
                "settings": library.settings.to_json(),
                "selection": of.to_json(),
                "folder": str(files.folder),
                "made_as": made_as,
                "maps": maps,
                "automatic": wanted.automatic,
            }
            link = _url(target.name).lstrip("/")
            return {
                "job": jobs.submit("recording", f"Recording of {of.told}", arguments, target.name, link, there=False)
            }
        if there:
            response.status_code = 200
            if not (wanted.automatic or request.app.state.read_only):
                files.keep(path.name)
        return {
            "name": path.name,
            "url": _url(path.name),
            "bytes": path.stat().st_size,
            "seconds": None if there else time.perf_counter() - started,
        }

    @router.get("/api/recordings/{name}.rrd")
    def recording(name: str) -> Response:
        path = files.path(name)
        with path.open("rb"):  # or it is said, before anything is sent, that nobody may
            pass
        return FileResponse(path, media_type="application/octet-stream", filename=path.name)

    @router.put("/api/recordings/{name}.rrd", status_code=201)
    async def add(name: str, request: Request) -> dict[str, Any]:
        await asyncio.to_thread(files.free, name)
        most = max(0, min(LARGEST, await asyncio.to_thread(disk, files.folder) - SPARED))
        _fits(int(request.headers.get("content-length", 0)), most)
        part = await asyncio.to_thread(files.part)
        try:
            await _receive(request, part, most)
            about = await asyncio.wrap_future(files.examine(part))
            added = await asyncio.to_thread(files.add, part, name, about)
            return await asyncio.to_thread(shown, added)
        finally:
            part.unlink(missing_ok=True)

    @router.patch("/api/recordings/{name}.rrd")
    def change(name: str, wanted: ChangeRequest) -> dict[str, Any]:
        changed = files.one(name)
        if wanted.tags is not None:
            changed = files.tag(name, wanted.tags)
        if wanted.name is not None:
            changed = files.rename(name, wanted.name)
        if wanted.automatic is not None:
            changed = files.keep(changed.name)
        return shown(changed)

    @router.delete("/api/recordings/{name}.rrd")
    def delete(name: str) -> dict[str, str]:
        return {"deleted": files.delete(name)}

    @router.post("/api/recordings/{name}.rrd/run", status_code=202)
    def open_run(name: str) -> dict[str, Job]:
        one = files.one(name)
        about = one.about
        if about is None or about.problem:
            raise BadInput(about.problem if about else f"{one.name!r} is looked into just now.")
        assert about.filter is not None
        filters = library.filters(str(about.task))
        key = repr((one.name, one.bytes, one.modified))
        run = f"{one.name.removesuffix(ENDING)} {hashlib.sha256(key.encode()).hexdigest()[:8]}"
        shown = name_of(about.filter, about.checkpoint_hash, filters)
        link = moment_link(find_task(str(about.task)), shown, PREFIX + run, about.episode or 0, 0)
        made = library.live.folder / f"{run}{SUFFIX}"
        arguments = {"recording": str(files.path(name)), "run": str(made)}
        return {"job": jobs.submit("reading", f"The run in {one.name}", arguments, key, link, made.is_file())}

    @router.post("/api/recordings/deleted/{id}")
    def restore(id: str) -> dict[str, Any]:
        return shown(files.restore(id))

    @router.delete("/api/recordings/deleted")
    def empty() -> dict[str, int]:
        freed = sum(one.bytes for one in files.deleted())
        files.empty()
        return {"freed": freed}

    def shown(one: Recording) -> dict[str, Any]:
        return _shown(one, *runs.of(one.about, runs.tasks()))

    return router


def write(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """The job that records a run with likelihood maps. What was traced before is read, not traced again."""
    library, files = Library(Settings.of_json(arguments["settings"])), RrdFiles(Path(arguments["folder"]))
    try:
        report(0.0, "running the filter")
        traced = library.traced(Selection.of_json(arguments["selection"]))
        path = _written(files, traced, arguments["made_as"], arguments["automatic"], arguments["maps"], report)
        return {"name": path.name}
    finally:
        files.close()
        library.close()


def _written(
    files: RrdFiles,
    traced: Traced,
    made_as: str,
    automatic: bool,
    stride: int = 0,
    report: Report = lambda share, message: None,
) -> Path:
    """A new recording. Stride: of the steps with likelihood maps; none for 0."""
    from beliefscope.recordings.rerun_log.metadata import describe  # bring Rerun, a second of a server's start
    from beliefscope.recordings.write import write_recording

    trace = traced.trace
    steps = range(0, len(trace), stride) if stride else range(0)

    def maps() -> Iterator[LikelihoodMap]:
        for done, one in enumerate(traced.maps(steps), start=1):
            report(done / len(steps), f"likelihood maps, {done} of {len(steps)}")
            yield one

    part = files.part()
    try:
        write_recording(trace, part, maps(), diagnostics=quick(trace, traced.checkpoint))
        return files.put(part, About.of(describe(part), part), made_as, automatic)
    finally:
        part.unlink(missing_ok=True)


def work(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """The job that makes a recording a run of the workspace, as a filter that ran live would have left it."""
    from beliefscope.recordings.read import read_recording  # brings Rerun

    report(0.0, "reading the recording")
    run, path = read_recording(arguments["recording"]), Path(arguments["run"])
    report(0.5, "writing its steps")
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    part.unlink(missing_ok=True)
    writer = GrowingWriter(part, run, len(run))
    try:
        writer.append(run)
        writer.finish()
        part.replace(path)
    finally:
        writer.close()
        part.unlink(missing_ok=True)
    return {"run": path.name.removesuffix(SUFFIX), "steps": len(run)}


class Runs:
    """Which of a server's own runs its recordings are of."""

    def __init__(self, library: Library) -> None:
        self._library = library
        self._data: dict[tuple[str, int, str], str | None] = {}

    def tasks(self) -> dict[str, Any]:
        """Those of the catalog by name."""
        return {task["name"]: task for task in self._library.catalog()["tasks"]}

    def of(self, about: About | None, tasks: Mapping[str, Any]) -> tuple[dict[str, str] | None, str]:
        """Names of filter and data set whose run this is, and why there is none. Tasks: as ``tasks`` gives them."""
        if about is None or about.problem:
            return None, "" if about is None else about.problem
        assert about.task is not None
        assert about.episode is not None
        filters = tasks[about.task]["filters"] if about.task in tasks else ()
        filter_ = next((one["name"] for one in filters if one["checkpoint_hash"] == about.checkpoint_hash), None)
        settings = self._library.settings
        if filter_ is None:
            short = about.checkpoint_hash[:8]
            why = f"Its filter, {about.filter} of {about.task} with checkpoint {short}, is not one of this server's."
        elif about.edited:
            why = "Some of its steps were edited by hand: the tab Compare runs it again."
        elif about.seed != settings.seed:
            why = f"It was run with seed {about.seed}; this server runs filters with seed {settings.seed}."
        elif about.particles not in (None, settings.particles):
            why = f"It was run with {about.particles} particles; this server's filters have {settings.particles}."
        elif (data := self._data_set(tasks[about.task], about.episode, about.data_hash)) is None:
            why = f"No data set of this server has its episode {about.episode}, {about.data_hash[:8]}."
        else:
            return {"filter": filter_, "data": data}, ""
        return None, why

    def _data_set(self, task: Mapping[str, Any], index: int, digest: str) -> str | None:
        """Name of the one whose episode this is; looked for once, since data sets stay what they are."""
        key = task["name"], index, digest
        if key not in self._data:
            self._data[key] = None
            for data in task["data"]:
                with suppress(BadInput):  # an episode that cannot be read is not this one
                    _, episodes = self._library.dataset(task["name"], data["name"])
                    if 0 <= index < len(episodes) and episodes[index].digest() == digest:
                        self._data[key] = data["name"]
                        break
        return self._data[key]


def _shown(one: Recording, run: dict[str, str] | None, why_not: str) -> dict[str, Any]:
    return {
        "name": one.name,
        "url": _url(one.name),
        "bytes": one.bytes,
        "modified": datetime.fromtimestamp(one.modified, UTC).isoformat(timespec="seconds"),
        "automatic": one.automatic,
        "tags": one.tags,
        "reading": one.about is None,
        **asdict(one.about or About()),
        "run": run,
        "why_not": why_not,
    }


def _url(name: str) -> str:
    return f"/api/recordings/{quote(name)}"


def _fits(size: int, most: int) -> None:
    if size > most:
        raise HTTPException(413, f"The file has more than {most / 1e6:,.0f} MB, which is all that is taken here.")


async def _receive(request: Request, part: Any, most: int) -> None:
    """Writes a body to a file as it comes, and no more of it than may be."""
    size, start = 0, b""
    with part.open("xb") as file:
        try:
            async for chunk in request.stream():
                size += len(chunk)
                _fits(size, most)
                if len(start) < len(MAGIC):
                    start += chunk[: len(MAGIC)]
                    if not MAGIC.startswith(start[: len(MAGIC)]):
                        raise BadInput("This is not a Rerun recording: an .rrd file begins with RRF and a digit.")
                await asyncio.to_thread(file.write, chunk)
                if size // LOOK > (size - len(chunk)) // LOOK:  # others fill the disk meanwhile, with files of theirs
                    _fits(size, size + await asyncio.to_thread(disk, part.parent) - SPARED)
        except ClientDisconnect:
            raise HTTPException(400, f"The file ended after {size} bytes.") from None
