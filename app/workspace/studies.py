"""Folders of studies: tables in ``study.json`` and the trained checkpoints."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, Field, ValidationError

from beliefscope.app.protocol.messages import describe_error
from beliefscope.app.workspace.json_files import content
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.filters.legacy_names import rename_keys
from beliefscope.filters.training.study_table import Row

BUILT_IN = "shipped"
"""Name of the built-in study. The checkpoints of its first seed are the pretrained filters."""

FILE = "study.json"
FINISHED = "finished"

CellName = Annotated[str, Field(pattern=r"^[\w.+-]+/[\w.+-]+/seed\d+$")]
"""TASK/FILTER/seedK."""


OLD_KEYS = {"asked": "requested", "each": "by_seed", "alone": "standalone"}
"""Keys of rows in files of earlier versions."""


def _rename(row: Any) -> Any:
    return rename_keys(row, OLD_KEYS) if isinstance(row, Mapping) else row


class Results(BaseModel):
    """Content of ``study.json``.

    checkpoints: trained cell -> hash; missing in files of earlier versions. cells: cell -> state. given: name ->
    checkpoint file or build function of each filter that was evaluated only.
    """

    preset: str
    tasks: Mapping[str, Mapping[str, str]]
    seeds: Annotated[int, Field(ge=1)]
    rows: list[Annotated[Row, BeforeValidator(_rename)]]
    checkpoints: Mapping[CellName, str] = {}
    cells: Mapping[CellName, str] = {}
    given: Mapping[str, str] = {}

    @property
    def unfinished(self) -> list[str]:
        """Names of the unfinished cells."""
        return [name for name, state in self.cells.items() if state != FINISHED]


@dataclass(frozen=True)
class Study:
    """The folder of a study. name: on the page. has_checkpoints: whether ``cells/`` contains the checkpoints."""

    name: str
    folder: Path
    has_checkpoints: bool

    def read(self) -> Results:
        """The current results. Raises BadInput if there are none or they are invalid."""
        path = self.folder / FILE
        try:
            return Results.model_validate(read_json(content(path)))
        except OSError:
            raise BadInput(f"{str(self.folder)!r} is not a study: it has no {FILE}") from None
        except ValueError as error:
            reason = describe_error(error) if isinstance(error, ValidationError) else error
            raise BadInput(f"{str(path)!r} does not contain the results of a study: {reason}") from None

    def checkpoint(self, cell: str) -> Path:
        """Path of a cell's checkpoint."""
        return self.folder / "cells" / f"{cell}.safetensors"
