"""The server: one port and one origin for the page, its data, the 3D scenes and Rerun's viewer."""

import asyncio
import contextlib
import gc
import logging
import signal
import socket
import sys
import threading
from collections.abc import AsyncIterator, Callable
from concurrent.futures import CancelledError
from pathlib import Path
from types import FrameType

import uvicorn
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse, Response
from starlette.exceptions import HTTPException

from beliefscope import __version__
from beliefscope.app.api import (
    comparison,
    diagnosis,
    diagnostics,
    experiments,
    failures,
    figures,
    finetune,
    jobs as api_jobs,
    lineage,
    live,
    recordings,
    reports,
    studies,
    traces,
    views as api_views,
)
from beliefscope.app.api.models import Error
from beliefscope.app.jobs.queue import Jobs
from beliefscope.app.protocol.errors import InProgress, NameTaken, NotFound, QueueFull
from beliefscope.app.protocol.messages import describe_error
from beliefscope.app.runs.settings import Settings
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.runs.trace_worker import TraceWorker
from beliefscope.app.server.auth import LOOPBACK, OPEN, VARIABLE, Access, host_names
from beliefscope.app.server.logs import is_relevant
from beliefscope.app.server.plain_pages import POLICY, not_found_page
from beliefscope.app.server.security import Guard
from beliefscope.app.server.static_files import PageFiles
from beliefscope.app.server.timeouts import MAX_HEAD, UNREAD_TIMEOUT, HTTPProtocol, WebSocketProtocol
from beliefscope.app.server.vendor_files import UPLOT_FILES, viewer_wasm
from beliefscope.app.views.memory import freeze_heap, limit_malloc_arenas
from beliefscope.app.views.registry import Views
from beliefscope.app.workspace.partial_files import delete_abandoned_parts
from beliefscope.app.workspace.recordings import RecordingFolder
from beliefscope.datasets.errors import BadInput
from beliefscope.inspect.maps.map_engine import COARSE
from beliefscope.recordings.web_viewer import WebViewer, installed

PAGE = Path(__file__).parents[1] / "page"
ERRORS: tuple[type[Exception], ...] = (InProgress, BadInput, RequestValidationError, HTTPException, OSError)
STATUS: dict[type[Exception], int] = {QueueFull: 429, NotFound: 404, NameTaken: 409}
FIRST_PAGE = 4.0  # s from the first run until Rerun's viewer is prepared
log = logging.getLogger("beliefscope.app")


def create_app(settings: Settings, warm: bool = True, subprocess: bool = False, access: Access = OPEN) -> FastAPI:
    """The application. Its threads start and end with its lifespan.

    warm: prepare the first page's trace and Rerun's viewer in the background at startup. subprocess: run filters in a
    subprocess instead of a thread. access: required token and permissions.

    Raises BadInput if the workspace cannot be created.
    """
    try:
        settings.workspace.mkdir(mode=0o700, parents=True)
    except FileExistsError:  # reported by the code that needs the folder
        pass
    except OSError as failure:
        raise BadInput(f"workspace {str(settings.workspace)!r} cannot be created: {failure.strerror}") from None
    delete_abandoned_parts(settings.workspace)
    store = TraceStore(settings, TraceWorker() if subprocess else None)
    views = Views(store, settings.views)
    jobs = Jobs(settings.workspace / "jobs", settings=settings.to_json())
    viewer = WebViewer(settings.workspace / "cache")
    files = RecordingFolder(settings.workspace / "recordings")

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        closing_idle = asyncio.create_task(views.close_expired())
        stopping = threading.Event()
        warming = threading.Thread(target=_warm, args=(store, viewer, stopping), name="warming")
        if warm:
            warming.start()
        yield
        stopping.set()
        closing_idle.cancel()
        await views.close()
        for close in (jobs.close, files.close, store.close):
            await asyncio.to_thread(close)
        # A thread in C++ code at interpreter exit aborts the process.
        if warm:
            await asyncio.to_thread(warming.join)
            gc.unfreeze()  # exit frees no frozen objects; DuckDB reports each as a leak

    app = FastAPI(
        title="Beliefscope",
        version=__version__,
        lifespan=lifespan,
        responses={"4XX": {"model": Error}},
        docs_url=None,
        redoc_url=None,
        openapi_url=None,
    )
    app.state.store, app.state.views, app.state.jobs = store, views, jobs
    app.state.read_only = access.read_only
    traces.add_routes(app, store, views)
    api_views.add_routes(app, views)
    api_jobs.add_routes(app, jobs)
    diagnosis.add_routes(app, store, jobs)
    diagnostics.add_routes(app, store, jobs)
    comparison.add_routes(app, store)
    figures.add_routes(app, store, files.writer)
    failures.add_routes(app, store, jobs)
    finetune.add_routes(app, store, jobs)
    recordings.add_routes(app, store, files, jobs)
    reports.add_routes(app, store, jobs)
    live.add_routes(app, store)
    studies.add_routes(app, store, jobs)
    experiments.add_routes(app, store)
    lineage.add_routes(app, store)
    _add_files(app, viewer)
    app.add_middleware(Guard, hosts=settings.hosts, access=access)
    for error in ERRORS:
        app.add_exception_handler(error, _error_response)
    return app


def serve(
    settings: Settings,
    host: str = "127.0.0.1",
    port: int = 8000,
    on_start: Callable[[str], None] = lambda url: None,
    access: Access = OPEN,
) -> None:
    """Serve on one port until SIGINT, SIGTERM or SIGHUP.

    Args:
        host, port: address to listen on; port 0 selects a free one.
        on_start: called with the printed URL of the page, including the token, once the server accepts connections.
        access: see ``create_app``; a token is required if others can reach the host.

    Raises BadInput if the address is not available or not allowed, or if a file cannot be used.
    """
    if host not in LOOPBACK and not access.token:
        raise BadInput(f"{host} is reachable from other machines: set a token in {VARIABLE}.")
    limit_malloc_arenas()
    with listen(host, port) as listener:  # before anything is created
        app = create_app(settings, subprocess=True, access=access)
        problems = app.state.store.problems()
        if problems:
            raise BadInput("; ".join(problems))
        name = host_names(host)[0]
        url = f"http://{f'[{name}]' if ':' in name else name}:{listener.getsockname()[1]}/"
        logging.getLogger("uvicorn.error").addFilter(is_relevant)

        def started() -> None:
            event = {
                "url": url,
                "version": __version__,
                "token_required": bool(access.token),
                "read_only": access.read_only,
            }
            log.info("started", extra={"event": event})
            print(f"Beliefscope is at {access.link(url)} (press Ctrl-C to stop)", flush=True)
            on_start(access.link(url))

        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # as under nohup; sent when the terminal closes
            handled = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
            uvicorn.server.HANDLED_SIGNALS = handled  # type: ignore[assignment]
        # A response passes through several threads, which may each wait this long for the GIL; the default is 5 ms.
        sys.setswitchinterval(0.001)
        config = uvicorn.Config(
            app,
            http=HTTPProtocol,
            ws=WebSocketProtocol,
            h11_max_incomplete_event_size=MAX_HEAD,
            proxy_headers=False,  # any local process could send them
            log_config=None,
            log_level="warning",
            access_log=False,
            server_header=False,
            ws_max_size=1 << 20,  # pages send a few KB
            ws_per_message_deflate=False,  # compression reduces binary messages from 300 to 12 MB/s
            timeout_graceful_shutdown=3,
        )
        server = _Server(config, started)
        if threading.current_thread() is threading.main_thread():
            # uvicorn restores these handlers at its end, and the default ones would end the process before its own end.
            for number in uvicorn.server.HANDLED_SIGNALS:
                signal.signal(number, server.handle_exit)
        server.run(sockets=[listener])
        log.info("stopped", extra={"event": {"url": url}})


class _Server(uvicorn.Server):
    def __init__(self, config: uvicorn.Config, on_start: Callable[[], None]) -> None:
        super().__init__(config)
        self._on_start = on_start

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        if self.started:
            self._on_start()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Begin the shutdown. Unlike uvicorn's, a second signal does not skip the lifespan, which ends the jobs."""
        self.should_exit = True


def _add_files(app: FastAPI, viewer: WebViewer) -> None:
    uplot = installed("uplot") / "static"
    files = PageFiles(PAGE, [uplot / name for name in UPLOT_FILES])
    app.get("/")(files.index)
    app.get("/static/{path:path}")(files.file)

    @app.get("/vendor/rerun/viewer.js")
    def viewer_script() -> Response:
        return Response(viewer.script(), media_type="text/javascript")

    @app.get("/vendor/rerun/re_viewer_bg.wasm")  # the name that viewer.js requests
    def viewer_module(request: Request) -> Response:
        return viewer_wasm(viewer, request)


def _warm(store: TraceStore, viewer: WebViewer, stopping: threading.Event) -> None:
    """Prepare what the first page requests. Errors are only logged; the page's own request reports them."""
    for prepare in (
        store.catalog,  # the page's first request; a run at the same time would delay it
        lambda: store.request(store.default_selection()).encoded_maps(0, COARSE),
        lambda: stopping.wait(FIRST_PAGE),  # a page that opens now needs the processor
        lambda: viewer.prepare(stopping.is_set),
        freeze_heap,
    ):
        try:
            if not stopping.is_set():
                prepare()
        except (Exception, CancelledError) as error:
            if not stopping.is_set():
                log.warning("not prepared in advance: %s", error)


def _error_response(request: Request, error: Exception) -> Response:
    """The response to a request that raises one of ``ERRORS``."""
    match error:
        case InProgress():
            return JSONResponse({"progress": error.args[0]}, 202)
        case BadInput():
            return JSONResponse({"error": str(error)}, STATUS.get(type(error), 400))
        case RequestValidationError():
            return JSONResponse({"error": describe_error(error)}, 422)
        case HTTPException(status_code=404) if "text/html" in request.headers.get("accept", ""):  # opened in a browser
            return HTMLResponse(not_found_page(request.url.path), 404, POLICY)
        case HTTPException():
            return JSONResponse({"error": error.detail}, error.status_code, headers=error.headers)
        case OSError() if error.filename is not None:  # the user can fix it, such as missing permissions
            return JSONResponse({"error": f"{str(error.filename)!r} cannot be used: {error.strerror}."}, 400)
    raise error


def listen(host: str, port: int) -> socket.socket:
    """A listening socket. Raises BadInput if the address is not available."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # asyncio sets TCP_NODELAY only if the protocol is given; without it, small messages are delayed by 40 ms.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # on Linux; accepted connections inherit it
            listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, UNREAD_TIMEOUT)
        listener.bind((host, port))
        listener.listen(128)
    except (OSError, OverflowError) as error:
        listener.close()
        reason = getattr(error, "strerror", None) or str(error)
        raise BadInput(
            f"Cannot listen on {host} port {port}: {reason}. Choose another --port (0: any free one)."
        ) from None
    return listener
