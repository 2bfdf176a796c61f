"""Which checkpoint was made from which, as their headers say, and a copy of one with its ancestors to hand on."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from beliefscope.datasets.errors import BadInput, one_of
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.filters.checkpoint import PRETRAINED, Checkpoint, load_checkpoint
from beliefscope.inspect.diagnostics.base import as_json

FEWEST_DIGITS = 4
"""Of a hash, to name a checkpoint by."""

README = """# {name} for task {task}

A trained filter of Beliefscope{ancestors}. `lineage.json` says where each file comes from, how it was
trained and how well it does; the SHA-256 of a file is its checkpoint's hash. Load it with Beliefscope {version}:

```sh
beliefscope evaluate {task} --filter {file}
beliefscope serve --filter {file}
beliefscope lineage .
```

In Python:

```python
from pathlib import Path
from beliefscope.filters.checkpoint import load_checkpoint

checkpoint = load_checkpoint(Path("{file}"))
assert checkpoint.hash == "{hash}"
```
"""


@dataclass(frozen=True)
class Ancestor:
    """One checkpoint of a lineage.

    Attributes:
        hash: SHA-256 of its file. path: of that file. task, name: of its filter.
        parent: hash of the checkpoint that it was made from; None where it was trained from nothing.
        command: that made it. settings: of the fine-tuning; empty where there was none.
        metrics: those of its record, as they are: by chance of black pictures, fused and by modality.
        record: all that it says of its training.
    """

    hash: str
    path: Path
    task: str
    name: str
    parent: str | None
    command: str
    settings: Mapping[str, Any]
    metrics: Mapping[str, Any]
    record: Mapping[str, Any]

    @classmethod
    def of(cls, checkpoint: Checkpoint, path: Path) -> Ancestor:
        record = dict(checkpoint.record)
        parent = record.get("parent") or {}
        return cls(
            hash=checkpoint.hash,
            path=path,
            task=checkpoint.task.name,
            name=checkpoint.name,
            parent=parent.get("hash"),
            command=str(record.get("command", "")),
            settings=parent.get("settings") or {},
            metrics=record.get("metrics") or {},
            record=record,
        )

    @property
    def rmse(self) -> Mapping[str, float]:
        """Of the fused estimate on whole sensors, in cm and deg, position first; empty where its record has none."""
        found = (self.metrics.get("0") or {}).get("fused", {}).get("rmse")
        if not isinstance(found, Mapping):
            return {}
        return {name: found[name] for name in sorted(found, key=lambda name: name != "position_cm")}


@dataclass(frozen=True)
class Lineage:
    """Checkpoints by hash, each before its children. left_out: files that are none, and why."""

    members: Mapping[str, Ancestor]
    left_out: tuple[str, ...]

    @property
    def roots(self) -> list[Ancestor]:
        """Those that were made from nothing, or from a checkpoint that is not here."""
        return [one for one in self.members.values() if one.parent not in self.members]

    def children(self, hash: str) -> list[Ancestor]:
        """Those that were made from this one."""
        return [one for one in self.members.values() if one.parent == hash]

    def line(self, hash: str) -> list[Ancestor]:
        """From the first ancestor that is here to this one."""
        found = [self.members[hash]]
        while found[0].parent in self.members:
            found.insert(0, self.members[str(found[0].parent)])
        return found

    def find(self, named: str) -> Ancestor:
        """By its path, or the first digits of its hash. Raises BadInput where that is none or several."""
        found = [one for one in self.members.values() if one.path == Path(named) or str(one.path.name) == named]
        if not found and len(named) >= FEWEST_DIGITS:
            found = [one for one in self.members.values() if one.hash.startswith(named.lower())]
        if len(found) != 1:
            available = [f"{one.path.name} ({one.hash[:12]})" for one in found or self.members.values()]
            if found:
                raise BadInput(f"checkpoint {named!r} is one of several: {', '.join(available)}")
            raise one_of("checkpoint", named, available)
        return found[0]

    def to_dict(self) -> dict[str, Any]:
        """As JSON values, each member with the hashes of its children."""
        members = [
            {
                **as_json({name: getattr(one, name) for name in SHOWN}),
                "path": str(one.path),
                "children": [child.hash for child in self.children(one.hash)],
            }
            for one in self.members.values()
        ]
        return {"members": members, "roots": [one.hash for one in self.roots], "left_out": list(self.left_out)}


SHOWN = ("hash", "task", "name", "parent", "command", "settings", "metrics")


def lineage_of(places: Iterable[Path], shipped: Path = PRETRAINED) -> Lineage:
    """The checkpoints in folders, those below them too, and files; and what ships of their ancestors.

    Raises BadInput for a place that is not there, and where no checkpoint is in any.
    """
    places = list(places)
    found: dict[str, Ancestor] = {}
    left_out: list[str] = []
    for place in places:
        if not place.exists():
            raise BadInput(f"{str(place)!r} does not exist")
        for path in sorted(place.rglob("*.safetensors")) if place.is_dir() else [place]:
            try:
                one = Ancestor.of(load_checkpoint(path), path)
            except BadInput as error:
                left_out.append(str(error))
                continue
            found.setdefault(one.hash, one)
    if not found:
        why = f": {left_out[0]}" if left_out else ""
        raise BadInput(f"no checkpoint is in {', '.join(repr(str(place)) for place in places)}{why}")
    missing = {one.parent for one in found.values() if one.parent} - found.keys()
    for path in sorted(shipped.glob("*.safetensors")) if missing else []:
        if hashlib.sha256(path.read_bytes()).hexdigest() in missing:
            one = Ancestor.of(load_checkpoint(path), path)
            found[one.hash] = one
    return Lineage(_parents_first(found), tuple(left_out))


def export(lineage: Lineage, hash: str, folder: Path, version: str) -> list[Path]:
    """Writes one checkpoint and its ancestors into a new folder, with ``lineage.json`` and a README.

    version: of this project, as the README names it. Raises BadInput where the folder is there already or cannot be.
    """
    if folder.exists():
        raise BadInput(f"{str(folder)!r} is there already; give the name of a new folder")
    if not folder.parent.is_dir():
        raise BadInput(f"folder {str(folder.parent)!r} does not exist, so {folder.name!r} cannot be made in it")
    line = lineage.line(hash)
    files = {one.hash: f"{one.task}-{one.name}-{one.hash[:12]}.safetensors" for one in line}
    manifest = {
        "checkpoint": files[hash],
        "members": [
            {**as_json({n: getattr(one, n) for n in SHOWN}), "file": files[one.hash], "record": as_json(one.record)}
            for one in line
        ],
    }
    last, above = line[-1], len(line) - 1
    ancestors = f", and the {above} checkpoint{'s' * (above > 1)} that it was made from" if above else ""
    about = {"task": last.task, "name": last.name, "hash": hash, "file": files[hash]}
    making = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        for one in line:
            data = one.path.read_bytes()
            if hashlib.sha256(data).hexdigest() != one.hash:
                raise BadInput(f"{str(one.path)!r} has changed since it was looked at")
            write_atomically(making / files[one.hash], data)
        write_atomically(making / "lineage.json", (json.dumps(manifest, indent=2, sort_keys=True) + "\n").encode())
        write_atomically(making / "README.md", README.format(ancestors=ancestors, version=version, **about).encode())
        os.chmod(making, 0o755)
        os.replace(making, folder)
    except BaseException:
        shutil.rmtree(making, ignore_errors=True)
        raise
    return sorted(folder.iterdir())


def _parents_first(found: Mapping[str, Ancestor]) -> dict[str, Ancestor]:
    """In the order in which they were found, but each after its parent."""
    ordered: dict[str, Ancestor] = {}

    def add(one: Ancestor) -> None:
        if one.parent in found and one.parent not in ordered:
            add(found[str(one.parent)])
        ordered.setdefault(one.hash, one)

    for one in found.values():
        add(one)
    return ordered
