"""Lineage of checkpoints from their headers, and export of a checkpoint with its ancestors."""

from __future__ import annotations

import hashlib
import json
import os
import shlex
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.datasets.text import plural
from beliefscope.filters.checkpoint import PRETRAINED, Checkpoint, load_checkpoint
from beliefscope.inspect.diagnostics.views import as_json

MIN_DIGITS = 4
"""Minimum number of hash digits that identify a checkpoint."""

README = """# {name} for task {task}

A trained Beliefscope filter{ancestors}. `lineage.json` lists origin, training and accuracy of
each file; the SHA-256 of a file is the hash of its checkpoint. Load it with Beliefscope {version}:

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
    """A checkpoint of a lineage.

    Attributes:
        hash: SHA-256 of its file.
        path: path of the file.
        task, name: task and name of its filter.
        base: hash of the checkpoint that it was fine-tuned from; None if trained from scratch.
        command: command that created it.
        settings: fine-tuning settings; empty if trained from scratch.
        metrics: metrics of its training record: by blackout probability, fused and by modality.
        record: complete training record.
    """

    hash: str
    path: Path
    task: str
    name: str
    base: str | None
    command: str
    settings: Mapping[str, Any]
    metrics: Mapping[str, Any]
    record: Mapping[str, Any]
    main: str

    @classmethod
    def from_checkpoint(cls, checkpoint: Checkpoint, path: Path) -> Ancestor:
        record = dict(checkpoint.record)
        base = base_of(record)
        return cls(
            hash=checkpoint.hash,
            path=path,
            task=checkpoint.task.name,
            name=checkpoint.name,
            base=base.get("hash"),
            command=str(record.get("command", "")),
            settings=base.get("settings") or {},
            metrics=record.get("metrics") or {},
            record=record,
            main=checkpoint.task.main_error.key,
        )

    @property
    def rmse(self) -> Mapping[str, float]:
        """RMSE of the fused estimate with clean sensors as displayed, the main error first; empty if not recorded."""
        rmse = (self.metrics.get("0") or {}).get("fused", {}).get("rmse")
        if not isinstance(rmse, Mapping):
            return {}
        return {name: rmse[name] for name in sorted(rmse, key=lambda name: name != self.main)}

    def summary(self, base: Ancestor | None) -> list[str]:
        """Lines of text: file and hash, errors with the data they are of, and the command. base: None if missing."""
        errors = ", ".join(f"{name.replace('_', ' ')} {value:.3g}" for name, value in self.rmse.items())
        data = self.record.get("data_hash")  # errors on different data are not comparable
        lines = [f"{self.path} {self.hash[:12]} {self.task} {self.name}"]
        lines += [f"RMSE {errors}{f', data {data[:12]}' if data else ''}"] if errors else []
        return lines + ([self._command(base)] if self.command else [])

    def _command(self, base: Ancestor | None) -> str:
        """The command with the path of the base checkpoint, whose record has only the name that its file had."""
        try:
            words = shlex.split(self.command)
        except ValueError:  # not a command line
            return self.command
        if base is None or not any(word.endswith(".safetensors") for word in words):
            return self.command
        return shlex.join([str(base.path) if word.endswith(".safetensors") else word for word in words])

    @property
    def learned(self) -> list[str]:
        """Names of the slices that it was fine-tuned on."""
        return [part["slice"]["name"] for part in self.settings.get("mix", [])]

    def held_out(self, when: Literal["before", "after"]) -> dict[str, Mapping[str, float]]:
        """Slice -> RMSE by component on the test episodes, before or after its fine-tuning; empty without one."""
        measures = self.record.get("held_out", {}).get(when, {})
        return {name: values.get("rmse") for name, values in measures.items()}


@dataclass(frozen=True)
class Lineage:
    """Checkpoints by hash, base checkpoints first. left_out: messages about files that are not checkpoints."""

    members: Mapping[str, Ancestor]
    left_out: tuple[str, ...]

    @property
    def roots(self) -> list[Ancestor]:
        """Checkpoints trained from scratch or whose base is not in the lineage."""
        return [member for member in self.members.values() if member.base not in self.members]

    def finetuned(self, hash: str) -> list[Ancestor]:
        """Checkpoints that were fine-tuned from this one."""
        return [member for member in self.members.values() if member.base == hash]

    def line(self, hash: str) -> list[Ancestor]:
        """Ancestors of a checkpoint, oldest first, and the checkpoint itself."""
        line = [self.members[hash]]
        while line[0].base in self.members:
            line.insert(0, self.members[str(line[0].base)])
        return line

    def find(self, name: str) -> Ancestor:
        """Find a checkpoint by path or by the first digits of its hash. Raises BadInput unless exactly one matches."""
        members = self.members.values()
        matches = [m for m in members if m.path == Path(name) or m.path.name == name]
        if not matches and len(name) >= MIN_DIGITS:
            matches = [m for m in members if m.hash.startswith(name.lower())]
        if len(matches) != 1:
            available = [f"{m.path.name} ({m.hash[:12]})" for m in matches or members]
            if matches:
                raise BadInput(f"checkpoint {name!r} is ambiguous: {', '.join(available)}")
            raise unknown_name("checkpoint", name, available)
        return matches[0]

    def __str__(self) -> str:
        """One tree per root; fine-tuned checkpoints are indented below their base."""

        def lines(member: Ancestor, indent: str) -> Iterator[str]:
            orphan = member.base is not None and member.base not in self.members
            note = [f"fine-tuned from {str(member.base)[:12]}, which is not in these folders"] if orphan else []
            first, *others = [*member.summary(self.members.get(str(member.base))), *note]
            yield indent + first
            yield from (f"{indent}  {line}" for line in others)
            for other in self.finetuned(member.hash):
                yield from lines(other, f"{indent}    ")

        return "\n".join(line for root in self.roots for line in lines(root, ""))

    def to_dict(self) -> dict[str, Any]:
        """JSON values; each member lists the hashes of checkpoints fine-tuned from it."""
        members = [
            {
                **as_json({name: getattr(member, name) for name in FIELDS}),
                "path": str(member.path),
                "finetuned": [other.hash for other in self.finetuned(member.hash)],
            }
            for member in self.members.values()
        ]
        return {"members": members, "roots": [root.hash for root in self.roots], "left_out": list(self.left_out)}


FIELDS = ("hash", "task", "name", "base", "command", "settings", "metrics")


def base_of(record: Mapping[str, Any]) -> Mapping[str, Any]:
    """Base checkpoint in a training record, empty if trained from scratch; earlier versions wrote ``parent``."""
    return record.get("base") or record.get("parent") or {}


def lineage_of(places: Iterable[Path], pretrained: Path = PRETRAINED) -> Lineage:
    """Read the checkpoints in files and folders (recursively), and their pretrained ancestors.

    Raises BadInput for a missing path, and if there is no checkpoint.
    """
    places = list(places)
    members: dict[str, Ancestor] = {}
    left_out: list[str] = []
    for place in places:
        if not place.exists():
            raise BadInput(f"{str(place)!r} does not exist")
        for path in sorted(place.rglob("*.safetensors")) if place.is_dir() else [place]:
            try:
                member = Ancestor.from_checkpoint(load_checkpoint(path), path)
            except BadInput as error:
                left_out.append(str(error))
                continue
            members.setdefault(member.hash, member)
    if not members:
        why = f": {left_out[0]}" if left_out else ""
        raise BadInput(f"no checkpoint in {', '.join(repr(str(place)) for place in places)}{why}")
    missing = {member.base for member in members.values() if member.base} - members.keys()
    for path in sorted(pretrained.glob("*.safetensors")) if missing else []:
        if hashlib.sha256(path.read_bytes()).hexdigest() in missing:
            member = Ancestor.from_checkpoint(load_checkpoint(path), path)
            members[member.hash] = member
    return Lineage(_bases_first(members), tuple(left_out))


def export(lineage: Lineage, hash: str, folder: Path, version: str) -> list[Path]:
    """Write a checkpoint and its ancestors to a new folder, with ``lineage.json`` and a README.

    Args:
        version: Beliefscope version named in the README.

    Raises BadInput if the folder exists or cannot be created. Returns the written files.
    """
    if folder.exists():
        raise BadInput(f"{str(folder)!r} exists; give the name of a new folder")
    if not folder.parent.is_dir():
        raise BadInput(f"folder {str(folder.parent)!r} does not exist, so {folder.name!r} cannot be created in it")
    line = lineage.line(hash)
    files = {m.hash: f"{m.task}-{m.name}-{m.hash[:12]}.safetensors" for m in line}
    manifest = {
        "checkpoint": files[hash],
        "members": [
            {**as_json({n: getattr(m, n) for n in FIELDS}), "file": files[m.hash], "record": as_json(m.record)}
            for m in line
        ],
    }
    last, count = line[-1], len(line) - 1
    ancestors = f" with its {plural(count, 'ancestor')}" if count else ""
    about = {"task": last.task, "name": last.name, "hash": hash, "file": files[hash]}
    temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        for member in line:
            data = member.path.read_bytes()
            if hashlib.sha256(data).hexdigest() != member.hash:
                raise BadInput(f"{str(member.path)!r} has changed since it was read")
            write_atomically(temporary / files[member.hash], data)
        write_atomically(temporary / "lineage.json", (json.dumps(manifest, indent=2, sort_keys=True) + "\n").encode())
        write_atomically(temporary / "README.md", README.format(ancestors=ancestors, version=version, **about).encode())
        os.chmod(temporary, 0o755)
        os.replace(temporary, folder)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    return sorted(folder.iterdir())


def _bases_first(members: Mapping[str, Ancestor]) -> dict[str, Ancestor]:
    """Reorder checkpoints so that each follows its base."""
    ordered: dict[str, Ancestor] = {}

    def add(member: Ancestor) -> None:
        if member.base in members and member.base not in ordered:
            add(members[str(member.base)])
        ordered.setdefault(member.hash, member)

    for member in members.values():
        add(member)
    return ordered
