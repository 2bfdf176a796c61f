"""Routes under ``/api/lineage``: which checkpoints were fine-tuned from which."""

import io
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path

from fastapi import FastAPI
from fastapi.responses import Response

from beliefscope import __version__
from beliefscope.app.api.models import Number, Reply
from beliefscope.app.protocol.errors import NotFound
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.workspace.finetune_runs import FineTuneRuns
from beliefscope.datasets.errors import BadInput
from beliefscope.inspect.compare.lineage import Ancestor, Lineage as Checkpoints, export, lineage_of


class LineageMember(Reply):
    """A checkpoint and its base.

    Attributes:
        catalog_name: its name in the catalog, or None. run: fine-tuning run of this workspace that wrote it, or None.
        train, learned: trained modules and learned slices. rmse: by component, in cm or deg, on clean data.
        before, after: slice -> RMSE by component on the test episodes of its fine-tuning.
    """

    hash: str
    name: str
    catalog_name: str | None
    base: str | None
    run: str | None
    train: list[str]
    learned: list[str]
    rmse: Mapping[str, Number]
    before: Mapping[str, Mapping[str, Number]]
    after: Mapping[str, Mapping[str, Number]]


class Lineage(Reply):
    """Fine-tuned checkpoints and their ancestors, bases first."""

    members: list[LineageMember]


def add_routes(app: FastAPI, store: TraceStore) -> None:
    @app.get("/api/lineage/{task}")
    def lineage(task: str) -> Lineage:
        names = {checkpoint.hash: name for name, checkpoint in store.filters(task).items()}
        members = _lineage(store, task).members.values()
        return Lineage(members=[_member(member, names, store) for member in members if member.task == task])

    @app.get("/api/lineage/{task}/{hash}.zip", response_class=Response)
    def archive(task: str, hash: str) -> Response:
        lineage = _lineage(store, task)
        member = lineage.members.get(hash)
        if member is None or member.task != task:
            raise NotFound(f"No checkpoint of task {task!r} has hash {hash!r}.")
        name = f"{task}-{member.name}-{hash[:12]}"
        content = io.BytesIO()
        with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(content, "w") as archive:
            for path in export(lineage, hash, Path(folder) / name, __version__):
                archive.write(path, f"{name}/{path.name}")
        headers = {"Content-Disposition": f'attachment; filename="{name}.zip"'}
        return Response(content.getvalue(), media_type="application/zip", headers=headers)


def _lineage(store: TraceStore, task: str) -> Checkpoints:
    """The workspace's fine-tuned checkpoints, those given to the server, and their ancestors.

    Raises BadInput for an unknown task.
    """
    store.filters(task)
    paths = [path for path in store.settings.checkpoints.values() if isinstance(path, Path)]
    try:
        return lineage_of([*FineTuneRuns(store.settings.workspace).checkpoints(), *paths])
    except BadInput:  # no checkpoint
        return Checkpoints({}, ())


def _member(checkpoint: Ancestor, names: dict[str, str], store: TraceStore) -> LineageMember:
    is_own = FineTuneRuns(store.settings.workspace).is_own(checkpoint.path)
    return LineageMember(
        hash=checkpoint.hash,
        name=checkpoint.name,
        catalog_name=names.get(checkpoint.hash),
        base=checkpoint.base,
        run=checkpoint.path.parent.name if is_own else None,
        train=checkpoint.settings.get("train", []),
        learned=checkpoint.learned,
        rmse=checkpoint.rmse,
        before=checkpoint.held_out("before"),
        after=checkpoint.held_out("after"),
    )
