"""Routes under ``/api/recordings``: list, write, upload, change, delete and restore recordings."""

from __future__ import annotations

import asyncio
import hashlib
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from urllib.parse import quote

from fastapi import FastAPI, HTTPException, Request, Response
from fastapi.responses import FileResponse
from pydantic import ConfigDict, NonNegativeInt, with_config
from starlette.requests import ClientDisconnect

from beliefscope import __version__
from beliefscope.app.api.models import DeletedId, Freed, JobReply, Reply, RequestBody
from beliefscope.app.jobs.queue import Jobs
from beliefscope.app.jobs.recording import write
from beliefscope.app.protocol.messages import READ_ONLY
from beliefscope.app.protocol.permalinks import page_link
from beliefscope.app.runs.live_runs import LIVE_PREFIX, display_name
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.workspace.recordings import ENDING, Recording, RecordingFolder, free_space
from beliefscope.app.workspace.trash import DeletedFile
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.text import plural
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.maps.likelihood_map import Quantity
from beliefscope.inspect.traces.live_file import SUFFIX
from beliefscope.recordings.probe import RecordingInfo

MAX_UPLOAD = 2 * 10**9  # bytes
RESERVED_SPACE = 2 * 10**8  # bytes that uploads leave free on the disk
POLL_INTERVAL = 0.2  # s between checks whether the client of an upload has cancelled it
CHECK_INTERVAL = 1 << 24  # uploaded bytes between checks of the free space
MAGIC = b"RRF"  # first bytes of all versions of Rerun's files
MAX_MATCHES = 4096  # recordings whose data set is remembered


class RunNames(Reply):
    """Names of a filter and a data set in the catalog."""

    filter: str
    data: str


@with_config(ConfigDict(json_schema_serialization_defaults_required=True))
@dataclass(frozen=True, kw_only=True)
class RecordingEntry(RecordingInfo):
    """A recording, with its metadata once they have been read.

    modified: ISO 8601. reading: whether its metadata are being read. run: the same run in the catalog, or None;
    ``why_not`` explains why.
    """

    name: str
    url: str
    bytes: int
    modified: str
    reading: bool
    run: RunNames | None
    why_not: str


class RecordingList(Reply):
    """Recordings, newest first, and deleted ones. bytes, free, largest: used, free, and allowed for an upload."""

    recordings: list[RecordingEntry]
    deleted: list[DeletedFile]
    bytes: int
    free: int
    largest: int


class WrittenRecording(Reply):
    """A recording of a run. seconds: that writing took; None if it existed."""

    name: str
    url: str
    bytes: int
    seconds: float | None


class RecordingRequest(RequestBody):
    """Body of ``POST /api/recordings``. maps: steps between maps of ``quantity``; 0 for none."""

    task: str
    filter: str
    episode: int
    faults: str = ""
    data: str = ""
    maps: NonNegativeInt = 0
    quantity: Quantity = "likelihood"


class NewName(RequestBody):
    """Body of ``PATCH /api/recordings/{name}.rrd``."""

    name: str


def add_routes(app: FastAPI, store: TraceStore, files: RecordingFolder, jobs: Jobs) -> None:
    matcher = RunMatcher(store)

    @app.get("/api/recordings")
    def list_recordings() -> RecordingList:
        recordings = files.list_recordings()
        free = free_space(files.folder)
        return RecordingList(
            recordings=[matcher.entry(recording) for recording in recordings],
            deleted=files.trash.list_deleted(),
            bytes=sum(recording.bytes for recording in recordings),
            free=free,
            largest=max(0, min(MAX_UPLOAD, free - RESERVED_SPACE)),
        )

    @app.post("/api/recordings", status_code=201)
    def write_recording(body: RecordingRequest, request: Request, response: Response) -> WrittenRecording | JobReply:
        start = time.perf_counter()
        selection = Selection(body.task, body.filter, body.episode, Faults.parse(body.faults), body.data)
        run = store.request(selection)
        # A growing run gets no maps: the job that computes them would see more steps than requested.
        stride = 0 if run.growing or run.no_maps else body.maps
        # The name covers everything that the file depends on.
        content = f"{run.key} maps {stride} {body.quantity} diagnostics version {__version__}"
        path = files.folder / f"{selection.file_stem}-{hashlib.sha256(content.encode()).hexdigest()[:8]}{ENDING}"
        existed = path.is_file()
        if not existed:
            if request.app.state.read_only:
                raise HTTPException(403, f"{READ_ONLY} There is no recording of this run.")
            if stride:
                response.status_code = 202
                arguments = {
                    "selection": selection.to_json(),
                    "path": str(path),
                    "maps": stride,
                    "quantity": body.quantity,
                }
                title, link = f"Recording of {selection.describe()}", _url(path.name).lstrip("/")
                job = jobs.submit("recording", title, arguments, link=link, output_exists=False)
                return JobReply(job=job)
            files.writer.submit(write, files, run, path).result()
        else:
            response.status_code = 200
        seconds = None if existed else time.perf_counter() - start
        return WrittenRecording(name=path.name, url=_url(path.name), bytes=path.stat().st_size, seconds=seconds)

    @app.post("/api/recordings/{name}.rrd/run", status_code=202)
    def open_run(name: str) -> JobReply:
        recording = files.get(name)
        info = recording.info
        if info is None or info.problem:
            raise BadInput(info.problem if info else f"{recording.name!r} is still being read.")
        assert info.filter is not None
        key = repr((recording.name, recording.bytes, recording.modified))
        run = f"{recording.name.removesuffix(ENDING)} {hashlib.sha256(key.encode()).hexdigest()[:8]}"
        filter_ = display_name(info.filter, info.checkpoint_hash, matcher.filters(str(info.task)))
        output = store.live.folder / f"{run}{SUFFIX}"
        link = page_link(task=info.task, filter=filter_, data=LIVE_PREFIX + run, episode=info.episode or 0, tab="scene")
        arguments, title = {"recording": str(files.path(name)), "run": str(output)}, f"The run in {recording.name}"
        return JobReply(job=jobs.submit("reading", title, arguments, link=link, output_exists=output.is_file()))

    _add_file_routes(app, files, matcher)


def _add_file_routes(app: FastAPI, files: RecordingFolder, matcher: RunMatcher) -> None:
    """Routes that do not need the runs."""

    @app.get("/api/recordings/{name}.rrd", response_class=Response)
    def download(name: str) -> FileResponse:
        path = files.path(name)
        with path.open("rb"):  # reports missing permissions before the response starts
            pass
        return FileResponse(path, media_type="application/octet-stream", filename=path.name)

    @app.put("/api/recordings/{name}.rrd", status_code=201)
    async def upload(name: str, request: Request) -> RecordingEntry:
        await asyncio.to_thread(files.path_for_new, name)
        limit = max(0, min(MAX_UPLOAD, await asyncio.to_thread(free_space, files.folder) - RESERVED_SPACE))
        _check_size(int(request.headers.get("content-length", 0)), limit)
        with files.partial_file() as part:
            await _receive(request, part, limit)
            info = await _unless_cancelled(request, asyncio.wrap_future(files.examine(part)))
            recording = await asyncio.to_thread(files.add, part, name, info)
            return await asyncio.to_thread(matcher.entry, recording)

    @app.patch("/api/recordings/{name}.rrd")
    def rename(name: str, body: NewName) -> RecordingEntry:
        return matcher.entry(files.rename(name, body.name))

    @app.delete("/api/recordings/{name}.rrd")
    def delete(name: str) -> DeletedId:
        return DeletedId(deleted=files.delete(name))

    @app.post("/api/recordings/deleted/{id}")
    def restore(id: str) -> RecordingEntry:
        return matcher.entry(files.restore(id))

    @app.delete("/api/recordings/deleted")
    def empty_trash() -> Freed:
        return Freed(freed=files.trash.empty())


class RunMatcher:
    """Finds the run of a recording in the server's catalog."""

    def __init__(self, store: TraceStore) -> None:
        self._store = store
        self._find_data = lru_cache(MAX_MATCHES)(self._search_data)  # data sets do not change

    def entry(self, recording: Recording) -> RecordingEntry:
        """The list entry of a recording."""
        run, why_not = self._match(recording.info)
        info = recording.info or RecordingInfo()
        if info.filter:
            info = replace(info, filter=self.filter_name(info.filter, info.checkpoint_hash, str(info.task)))
        return RecordingEntry(
            name=recording.name,
            url=_url(recording.name),
            bytes=recording.bytes,
            modified=datetime.fromtimestamp(recording.modified, UTC).isoformat(timespec="seconds"),
            reading=recording.info is None,
            **vars(info),
            run=run,
            why_not=why_not,
        )

    def filters(self, task: str) -> dict[str, Checkpoint]:
        """The filters of a task by name; none of a task that this server does not have."""
        with suppress(BadInput):
            return self._store.filters(task)
        return {}

    def filter_name(self, name: str, checkpoint_hash: str, task: str) -> str:
        """Name in the catalog of the filter of a file, or its own name, with its hash if another filter has it."""
        return display_name(name, checkpoint_hash, self.filters(task), checkpoint_hash[:6])

    def live_data(self) -> dict[tuple[str, int, str], str]:
        """Task, index and hash of the episodes of live runs -> name of their data; that of the newest run."""
        names: dict[tuple[str, int, str], str] = {}
        for name in self._store.live.newest():
            with suppress(BadInput):
                run = self._store.live[name]
                episode = run.task.name, run.template.episode_index, run.template.data_hash
                names.setdefault(episode, f"{LIVE_PREFIX}{name}")
        return names

    def data_name(self, task: str, episode: int, data_hash: str) -> str | None:
        """Name of the data set with an episode; None if there is none."""
        with suppress(BadInput):
            return self._find_data(task, episode, data_hash)
        return None

    def _match(self, info: RecordingInfo | None) -> tuple[RunNames | None, str]:
        """Names of the run's filter and data set, or None and the reason."""
        if info is None or info.problem:
            return None, "" if info is None else info.problem
        task, episode, settings = str(info.task), int(info.episode or 0), self._store.settings
        filters = self.filters(task).items()
        filter_ = next((name for name, filter_ in filters if filter_.hash == info.checkpoint_hash), None)
        if filter_ is None:
            short = info.checkpoint_hash[:8]
            reason = f"Filter {info.filter} of {task} with checkpoint {short} is not served here."
        elif info.edited:
            reason = "The run has interventions; reproduce it in the Compare tab."
        elif info.seed != settings.seed:
            reason = f"The run has seed {info.seed}; this server uses seed {settings.seed}."
        elif info.particles not in (None, settings.particles):
            reason = f"The run has {plural(info.particles or 0, 'particle')}; this server uses {settings.particles}."
        elif (data := self._find_data(task, episode, info.data_hash)) is None:
            reason = f"No data set of this server contains its episode {episode}, {info.data_hash[:8]}."
        else:
            return RunNames(filter=filter_, data=data), ""
        return None, reason

    def _search_data(self, task: str, index: int, digest: str) -> str | None:
        """Name of the data set with this episode."""
        for name, episodes in self._store.datasets(task).items():
            with suppress(BadInput):  # unreadable episodes do not match
                if 0 <= index < len(episodes) and episodes[index].digest() == digest:
                    return name
        return None


def _url(name: str) -> str:
    return f"/api/recordings/{quote(name)}"


def _check_size(size: int, limit: int) -> None:
    if size > limit:
        raise HTTPException(413, f"The file is larger than {limit / 1e6:,.0f} MB, the limit for uploads.")


async def _unless_cancelled(request: Request, examination: asyncio.Future[RecordingInfo]) -> RecordingInfo:
    """Wait for the result. Raises HTTPException if the client closes the connection before."""
    is_done = False
    while not is_done:
        is_done = bool((await asyncio.wait([examination], timeout=POLL_INTERVAL))[0])
        if await request.is_disconnected():
            examination.cancel()  # does not start if another file is being read
            raise HTTPException(400, "The upload was cancelled.")
    return examination.result()


async def _receive(request: Request, part: Path, limit: int) -> None:
    """Write the body to a file in chunks, with checks of format, size and free space."""
    size, start = 0, b""
    with part.open("xb") as file:
        try:
            async for chunk in request.stream():
                size += len(chunk)
                _check_size(size, limit)
                if len(start) < len(MAGIC):
                    start += chunk[: len(MAGIC)]
                    if not MAGIC.startswith(start[: len(MAGIC)]):
                        raise BadInput("The file is not a Rerun recording: .rrd files begin with RRF and a digit.")
                await asyncio.to_thread(file.write, chunk)
                if size // CHECK_INTERVAL > (size - len(chunk)) // CHECK_INTERVAL:  # other uploads may fill the disk
                    _check_size(size, size + await asyncio.to_thread(free_space, part.parent) - RESERVED_SPACE)
        except ClientDisconnect:
            raise HTTPException(400, f"The file ended after {size} bytes.") from None
