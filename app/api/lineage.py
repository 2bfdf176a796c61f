"""Which filters of the workspace were made from which, over HTTP (docs/api.md), and one with its ancestors."""

from __future__ import annotations

import io
import tempfile
import zipfile
from pathlib import Path
from typing import Any

from fastapi import APIRouter, HTTPException
from fastapi.responses import Response

from beliefscope import __version__
from beliefscope.app.runs.trace_store import Library
from beliefscope.datasets.errors import BadInput
from beliefscope.inspect.compare.lineage import Ancestor, Lineage, export, lineage_of
from beliefscope.inspect.diagnostics.base import as_json


def routes(library: Library) -> APIRouter:
    """Every route under ``/api/lineage``."""
    router = APIRouter()

    @router.get("/api/lineage/{task}")
    def lineage(task: str) -> dict[str, Any]:
        shelf = {checkpoint.hash: name for name, checkpoint in library.filters(task).items()}
        found = _found(library, task)
        members = [] if found is None else [one for one in found.members.values() if one.task == task]
        return {"members": [_shown(one, shelf, library) for one in members]}

    @router.get("/api/lineage/{task}/{hash}.zip")
    def archive(task: str, hash: str) -> Response:
        found = _found(library, task)
        if found is None or hash not in found.members:
            raise HTTPException(404, f"No checkpoint of task {task!r} has hash {hash!r}.")
        one = found.members[hash]
        name = f"{task}-{one.name}-{hash[:12]}"
        packed = io.BytesIO()
        with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(packed, "w") as archive:
            for path in export(found, hash, Path(folder) / name, __version__):
                archive.write(path, f"{name}/{path.name}")
        headers = {"Content-Disposition": f'attachment; filename="{name}.zip"'}
        return Response(packed.getvalue(), media_type="application/zip", headers=headers)

    return router


def _found(library: Library, task: str) -> Lineage | None:
    """Of what was fine-tuned in the workspace and what was given, with their ancestors; None where there is nothing."""
    library.filters(task)  # or there is no such task
    given = [path for path in library.settings.checkpoints.values() if isinstance(path, Path)]
    try:
        return lineage_of([*sorted(_runs(library).glob("*/child.safetensors")), *given])
    except BadInput:
        return None


def _runs(library: Library) -> Path:
    return library.settings.workspace / "finetune"


def _shown(one: Ancestor, shelf: dict[str, str], library: Library) -> dict[str, Any]:
    """run: of the fine-tuning that made it here. rmse: on whole sensors. before, after: by slice, on test episodes."""
    made_here = one.path.parent.parent == _runs(library)
    learned = [part["slice"]["name"] for part in one.settings.get("mix", [])]
    held_out = one.record.get("held_out", {})
    errors = {when: {name: said.get("rmse") for name, said in slices.items()} for when, slices in held_out.items()}
    shown: dict[str, Any] = as_json(
        {
            "hash": one.hash,
            "name": one.name,
            "shelf": shelf.get(one.hash),
            "parent": one.parent,
            "run": one.path.parent.name if made_here else None,
            "train": one.settings.get("train", []),
            "learned": learned,
            "rmse": one.rmse,
            "before": errors.get("before", {}),
            "after": errors.get("after", {}),
        }
    )
    return shown
