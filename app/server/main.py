"""The server: one port and one origin for the page, its data, the 3D scene and Rerun's viewer."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import socket
import sys
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import CancelledError
from pathlib import Path
from types import FrameType

import uvicorn
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from starlette.exceptions import HTTPException

from beliefscope import __version__
from beliefscope.app.api import comparison, diagnostics, failures, finetune, lineage, live, recordings, reports, studies
from beliefscope.app.api.traces import routes
from beliefscope.app.jobs import queue
from beliefscope.app.protocol.messages import MAP_SIZES
from beliefscope.app.runs.kept_filters import with_children
from beliefscope.app.runs.trace_store import Library, Settings
from beliefscope.app.runs.trace_worker import Tracer
from beliefscope.app.server.auth import LOOPBACK, OPEN, VARIABLE, Access, names_of
from beliefscope.app.server.logs import no_false_alarm
from beliefscope.app.server.security import Guard
from beliefscope.app.server.static_files import PageFiles
from beliefscope.app.server.timeouts import HEAD, READ_PATIENCE, PatientProtocol, PatientSocket
from beliefscope.app.server.vendor_files import UPLOT_FILES, RerunViewer, installed
from beliefscope.app.views.memory import few_heaps, settle
from beliefscope.app.views.view import Views
from beliefscope.app.workspace.partial_files import sweep
from beliefscope.app.workspace.recordings import RrdFiles
from beliefscope.app.workspace.trash import Gone, Taken
from beliefscope.datasets.errors import BadInput

__all__ = ["Settings", "create_app", "serve"]

PAGE = Path(__file__).parents[1] / "page"
log = logging.getLogger("beliefscope.app")


def create_app(settings: Settings, warm: bool = True, apart: bool = False, access: Access = OPEN) -> FastAPI:
    """The application; it starts no thread before its lifespan begins and leaves none behind when that ends.

    Args:
        settings: what to show and where to keep things.
        warm: prepare the first page's trace and Rerun's viewer in the background at the start.
        apart: run the filters in a process of their own; else a thread does.
        access: what whoever asks has to bring, and whether they may change anything.
    """
    with contextlib.suppress(FileExistsError):  # what is wrong with it is said by who needs it
        settings.workspace.mkdir(mode=0o700, parents=True)
    sweep(settings.workspace)
    tracer = Tracer() if apart else None
    library = Library(with_children(settings), tracer)
    views = Views(library, settings.views)
    work = queue.Jobs(settings.workspace / "jobs")
    rerun = RerunViewer(settings.workspace / "cache")
    rrds = RrdFiles(settings.workspace / "recordings")

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        tidying = asyncio.create_task(views.tidy())
        stopping = threading.Event()
        warming = threading.Thread(target=_warm, args=(library, rerun, stopping), name="warming")
        if warm:
            warming.start()
        yield
        stopping.set()
        tidying.cancel()
        await views.close()
        await asyncio.to_thread(work.close)
        await asyncio.to_thread(rrds.close)
        await asyncio.to_thread(library.close)
        # A thread that is inside C++ when Python ends takes the whole process down with an abort.
        if warm:
            await asyncio.to_thread(warming.join)

    app = FastAPI(title="Beliefscope", lifespan=lifespan, docs_url=None, redoc_url=None, openapi_url=None)
    app.state.library, app.state.views, app.state.jobs = library, views, work
    app.state.read_only = access.read_only
    for router in (
        routes(library, views),
        queue.routes(work),
        diagnostics.routes(library, work),
        comparison.routes(library),
        failures.routes(library, work),
        finetune.routes(library, work),
        recordings.routes(library, rrds, work),
        reports.routes(library, work),
        live.routes(library),
        studies.routes(library, work),
        lineage.routes(library),
    ):
        app.include_router(router)
    _add_files(app, rerun)
    app.add_middleware(Guard, hosts=settings.hosts, access=access)
    app.add_exception_handler(BadInput, _say(400))
    app.add_exception_handler(queue.QueueFull, _say(429))
    app.add_exception_handler(Gone, _say(404))
    app.add_exception_handler(Taken, _say(409))
    app.add_exception_handler(RequestValidationError, _say(422))
    app.add_exception_handler(HTTPException, _say(None))
    app.add_exception_handler(OSError, _say_of_a_file)
    return app


def serve(
    settings: Settings,
    host: str = "127.0.0.1",
    port: int = 8000,
    listening: Callable[[str], None] | None = None,
    access: Access = OPEN,
) -> None:
    """Serve until SIGINT, SIGTERM or SIGHUP, on one port.

    Args:
        settings: see ``create_app``.
        host, port: address to listen on; port 0 takes any free one.
        listening: called with the URL that opens the page, token included, once connections are accepted; the default
            prints it.
        access: see ``create_app``; a host that others can reach demands a token.

    Raises BadInput when the address cannot be had or may not be listened on, or something given cannot be shown.
    """
    if listening is None:
        listening = _print_url
    if host not in LOOPBACK and not access.token:
        raise BadInput(f"Others can reach {host}: a server there needs a token, in Access or in {VARIABLE}.")
    few_heaps()
    with _bound(host, port) as listener:  # first of all: without an address nothing is to be made
        app = create_app(settings, apart=True, access=access)
        problems = app.state.library.problems()
        if problems:
            raise BadInput("; ".join(problems))
        shown = names_of(host)[0]
        url = f"http://{f'[{shown}]' if ':' in shown else shown}:{listener.getsockname()[1]}/"
        logging.getLogger("uvicorn.error").addFilter(no_false_alarm)
        config = uvicorn.Config(
            app,
            http=PatientProtocol,
            ws=PatientSocket,
            h11_max_incomplete_event_size=HEAD,
            proxy_headers=False,  # anyone on this machine could write them
            log_config=None,
            log_level="warning",
            access_log=False,
            server_header=False,
            ws_max_size=1 << 20,  # pages say a few KB; 32 messages wait for us at most, then the browser waits
            ws_per_message_deflate=False,  # deflate takes binary messages from 300 to 12 MB/s
            timeout_graceful_shutdown=3,
        )

        def started() -> None:
            about = {
                "url": url,
                "version": __version__,
                "asks_for_token": bool(access.token),
                "read_only": access.read_only,
            }
            log.info("started", extra={"event": about})
            listening(access.link(url))

        # An answer passes through several threads, and each hand-over may wait this long for Python's lock: 5 ms else.
        sys.setswitchinterval(0.001)
        _Server(config, started).run(sockets=[listener])
        log.info("stopped", extra={"event": {"url": url}})


class _Server(uvicorn.Server):
    def __init__(self, config: uvicorn.Config, listening: Callable[[], None]) -> None:
        super().__init__(config)
        self._listening = listening

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        if self.started:
            self._listening()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Begins to end. At a second signal uvicorn would leave out what ends the jobs: they would go on."""
        self.should_exit = True

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Of SIGHUP too, which a terminal sends as it is closed, but where it is ignored (nohup)."""
        heard = threading.current_thread() is threading.main_thread() and (
            signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN
        )
        before = signal.signal(signal.SIGHUP, self.handle_exit) if heard else None
        try:
            with super().capture_signals():
                yield
        finally:
            if heard:
                signal.signal(signal.SIGHUP, before)


def _add_files(app: FastAPI, rerun: RerunViewer) -> None:
    uplot = installed("uplot") / "static"
    files = PageFiles(PAGE, [uplot / name for name in UPLOT_FILES])

    # From memory, in the event loop: a browser asks for all of them at once.
    @app.get("/")
    async def page(request: Request) -> Response:
        return files.index(request)

    @app.get("/static/{path:path}")
    async def page_file(path: str, request: Request) -> Response:
        return files.file(request, path)

    @app.get("/vendor/rerun/viewer.js")
    def rerun_script() -> Response:
        return Response(rerun.script(), media_type="text/javascript")

    @app.get("/vendor/rerun/viewer.wasm")
    @app.get("/vendor/rerun/re_viewer_bg.wasm")  # the name by which viewer.js asks for it
    def rerun_wasm(request: Request) -> Response:
        return rerun.wasm(request)


def _warm(library: Library, rerun: RerunViewer, stopping: threading.Event) -> None:
    """Have ready what the first page asks for, maps before Rerun. What fails is told to the page that asks for it."""
    for prepare in (
        lambda: library.traced(library.default()),  # begun, by another thread
        library.catalog,
        lambda: library.traced(library.default()).wired(0, None, MAP_SIZES[0]),
        lambda: rerun.prepare(stopping.is_set),
        settle,
    ):
        try:
            if not stopping.is_set():
                prepare()
        except (Exception, CancelledError) as error:
            if not stopping.is_set():
                log.warning("Not prepared in advance: %s", error)


def _say(status: int | None) -> Callable[[Request, Exception], JSONResponse]:
    def handler(_: Request, error: Exception) -> JSONResponse:
        if isinstance(error, HTTPException):
            return JSONResponse({"error": error.detail}, error.status_code, headers=error.headers)
        if isinstance(error, RequestValidationError):
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            return JSONResponse({"error": f"{where}: {first['msg']}"}, 422)
        return JSONResponse({"error": str(error)}, status or 500)

    return handler


def _say_of_a_file(_: Request, error: Exception) -> JSONResponse:
    """Of the workspace, mostly: no right to it, or a file where a folder should be. Its user can mend that."""
    if not isinstance(error, OSError) or error.filename is None:
        raise error
    return JSONResponse({"error": f"{str(error.filename)!r} cannot be used: {error.strerror}."}, 400)


def _bound(host: str, port: int) -> socket.socket:
    """A listening socket. Raises BadInput in one line when the address cannot be had."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # asyncio sends small messages at once (TCP_NODELAY) only where the protocol is named: else each waits 40 ms.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # on Linux; the connections that it accepts have it too
            listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, READ_PATIENCE)
        listener.bind((host, port))
        listener.listen(128)
    except (OSError, OverflowError) as error:
        listener.close()
        reason = getattr(error, "strerror", None) or str(error)
        raise BadInput(
            f"Cannot listen on {host} port {port}: {reason}. Choose another --port (0: any free one)."
        ) from None
    return listener


def _print_url(url: str) -> None:
    print(f"Beliefscope is at {url} (Ctrl+C stops it)", flush=True)
