"""Seeded mutations of valid files and documents. All randomness comes from the ``rng`` argument."""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import h5py
import numpy as np

HUGE = 10**12

TEXTS = (
    "",
    " ",
    "\0",
    "é☃",
    "\ud800",
    "../../etc/passwd",
    "x" * 300,
    "nan",
    "door",
    "image",
    "beliefscope-episodes",
    "%s%n",
    "1e999",
    "9" * 5000,
    "[" * 2000,
    "file.py:TASK",
)
NUMBERS = (
    0,
    -1,
    1,
    2,
    7,
    2**31,
    -(2**31),
    2**63,
    2**64,
    HUGE,
    10**400,
    0.5,
    -0.0,
    1e308,
    math.nan,
    math.inf,
    -math.inf,
)
RAW = (
    b"[" * 100_000,
    b'{"a":' * 50_000,
    b"9" * 5000,
    b"\xff\xfe",
    b"\xef\xbb\xbf{}",
    b"NaN",
    b"null",
    b"",
    b'"\\ud800"',
)


def random_value(rng: Random, depth: int = 3) -> Any:
    """Return a random JSON value."""
    kind = rng.randrange(8 if depth else 5)
    if kind == 0:
        return rng.choice((None, True, False))
    if kind in (1, 2):
        return rng.choice(NUMBERS)
    if kind in (3, 4):
        return rng.choice(TEXTS)
    if kind == 5:
        return [random_value(rng, depth - 1) for _ in range(rng.randrange(4))]
    return {rng.choice(TEXTS): random_value(rng, depth - 1) for _ in range(rng.randrange(4))}


def edit_document(document: Any, rng: Random) -> Any:
    """Return a copy of a JSON document with one value replaced, removed or duplicated."""
    document = json.loads(json.dumps(document))
    node, path = document, []
    while isinstance(node, dict | list) and node:
        key = rng.choice(list(node)) if isinstance(node, dict) else rng.randrange(len(node))
        path.append((node, key))
        if rng.random() < 0.3:
            break
        node = node[key]
    if not path:
        return random_value(rng)
    parent, key = path[-1]
    match rng.randrange(6):
        case 0:
            del parent[key]
        case 1 if isinstance(parent, list):
            parent.append(parent[key])
        case 2 if isinstance(parent, dict):
            parent[rng.choice(TEXTS)] = random_value(rng)
        case 3 if isinstance(parent[key], int | float | str):
            parent[key] = [parent[key]] if rng.random() < 0.5 else str(parent[key])
        case _:
            parent[key] = random_value(rng)
    return document


def corrupt_json(data: bytes, rng: Random) -> bytes:
    """Corrupt the values or the bytes of a JSON document."""
    match rng.randrange(8):
        case 0:
            return corrupt_bytes(data, rng)
        case 1:
            return rng.choice(RAW)
        case 2:  # a value that only raw text can have: huge, deeply nested, NaN
            text = json.dumps(edit_document(json.loads(data), rng)).encode()
            at = text.find(b": ")
            return text[: at + 2] + rng.choice(RAW) + b"}" if at >= 0 else text
        case _:
            document = json.loads(data)
            for _ in range(rng.randint(1, 3)):
                document = edit_document(document, rng)
            return json.dumps(document).encode()


def corrupt_bytes(data: bytes, rng: Random) -> bytes:
    """Flip, truncate, overwrite, move or insert bytes."""
    changed, size = bytearray(data), len(data)
    match rng.randrange(7):
        case 0 | 1:
            for _ in range(rng.choice((1, 1, 2, 8, 64))):
                at = _random_position(rng, size)
                changed[at] ^= 1 << rng.randrange(8)
        case 2:
            del changed[rng.randrange(size) :]
        case 3:
            at = _random_position(rng, size)
            length = rng.choice((1, 4, 8, 64))
            changed[at : at + length] = rng.choice((b"\0", b"\xff", b"\x7f")) * length
        case 4:
            at = _random_position(rng, size)
            changed[at : at + 8] = struct.pack("<Q", rng.choice((0, 1, 2**31, 2**32, 2**48, 2**63 - 1, 2**64 - 1)))
        case 5:
            at, source = _random_position(rng, size), _random_position(rng, size)
            changed[at : at + 32] = changed[source : source + 32]
        case 6:
            at = _random_position(rng, size)
            changed[at:at] = rng.randbytes(rng.choice((1, 3, 16)))
    return bytes(changed)


def _random_position(rng: Random, size: int) -> int:
    """Random position; half of the positions are near the start, where headers are."""
    return rng.randrange(min(size, 4096) if rng.random() < 0.5 else size)


def corrupt_safetensors(data: bytes, rng: Random, key: str) -> bytes:
    """Corrupt the bytes, header, stored document (under ``key``) or numbers of a safetensors file."""
    if rng.random() < 0.35:
        return corrupt_bytes(data, rng)
    (size,) = struct.unpack("<Q", data[:8])
    header, body = json.loads(data[8 : 8 + size]), bytearray(data[8 + size :])
    tensors = [name for name in header if name != "__metadata__"]
    tensor = header[rng.choice(tensors)]
    match rng.randrange(10):
        case 0 | 1 | 2 | 3:
            document = header["__metadata__"][key]
            header["__metadata__"][key] = corrupt_json(document.encode(), rng).decode(errors="replace")
        case 4:
            tensor["shape"] = rng.choice(
                ([], [0], [1], [HUGE], [2**32, 2**32], [-1], tensor["shape"][::-1], [*tensor["shape"], 1])
            )
        case 5:
            tensor["dtype"] = rng.choice(
                ("F64", "F16", "BF16", "I64", "I8", "BOOL", "F8_E4M3", "U64", "C64", "nonsense")
            )
        case 6:
            tensor["data_offsets"] = rng.choice(([0, 0], [0, HUGE], [8, 4], [0, len(body)], [2**63, 2**64 - 1]))
        case 7:
            begin, end = tensor["data_offsets"]
            number = rng.choice((math.nan, math.inf, 1e38, -1.0, 0.0))
            count = (end - begin) // 4
            body[begin : begin + 4 * count] = np.full(count, number, "<f4").tobytes()
        case 8:
            removed = header.pop(rng.choice(tensors))
            if rng.random() < 0.5:
                header[rng.choice(TEXTS)] = removed
        case 9:  # swap two tensors: the file itself stays valid
            other = rng.choice(tensors)
            header[other], header[tensors[0]] = header[tensors[0]], header[other]
    text = json.dumps(header).encode()
    length = rng.choice((0, 2**63, len(text) + 1)) if rng.random() < 0.05 else len(text)
    return struct.pack("<Q", length) + text + bytes(body)


def corrupt_live(data: bytes, rng: Random) -> bytes:
    """Corrupt the bytes, header or blocks of a live file; for header and blocks with valid checksums."""
    if rng.random() < 0.4:
        return corrupt_bytes(data, rng)
    parts, at = [], 0
    while at < len(data):  # header, then blocks up to the end
        mark, number, _ = struct.unpack_from("<4sII", data, at)
        following = data.find(b"step", at + 12) if mark != b"end\n" else len(data)
        following = following if following > 0 else len(data) - 12
        parts.append([mark, number, data[at + 12 : following]])
        at = following
    part = parts[0] if rng.random() < 0.6 else rng.choice(parts[1:])
    if part is parts[0]:
        header, end = json.JSONDecoder().raw_decode(part[2].decode("latin-1"))
        part[2] = corrupt_json(json.dumps(header).encode(), rng) + part[2][end:]
        part[1] = len(part[2])
    else:
        match rng.randrange(5):
            case 0:
                part[1] = rng.choice((0, 1, 2**31, 2**32 - 1))
            case 1:
                part[2] = np.full(len(part[2]) // 4, rng.choice((math.nan, math.inf, 1e38)), "<f4").tobytes()
            case 2:
                part[0] = rng.choice((b"end\n", b"step", b"BsL\n", b"\0\0\0\0"))
            case 3:
                parts.insert(rng.randrange(len(parts) + 1), list(part))
            case 4:
                part[2] = corrupt_bytes(part[2] or b"\0", rng)
    sums = [zlib.crc32(content, zlib.crc32(struct.pack("<4sI", mark, number))) for mark, number, content in parts]
    return b"".join(struct.pack("<4sII", *part[:2], crc) + part[2] for part, crc in zip(parts, sums, strict=True))


def corrupt_hdf5(path: Path, rng: Random) -> None:
    """Corrupt the bytes of an HDF5 file, or its content with h5py, in place."""
    if rng.random() < 0.4:
        path.write_bytes(corrupt_bytes(path.read_bytes(), rng))
        return
    with h5py.File(path, "r+") as file:
        groups = [file, *(member for member in file.values() if isinstance(member, h5py.Group))]
        for _ in range(rng.randint(1, 2)):
            group = rng.choice(groups[1:] or groups) if rng.random() < 0.8 else file
            (_corrupt_attribute if rng.random() < 0.4 and group.attrs else _corrupt_member)(group, rng)


def _corrupt_attribute(group: h5py.Group, rng: Random) -> None:
    name = rng.choice(list(group.attrs))
    if rng.random() < 0.2:
        del group.attrs[name]
        return
    if name == "provenance" and rng.random() < 0.7:
        text = corrupt_json(group.attrs[name].encode(), rng)
        group.attrs[name] = text.decode(errors="replace").replace("\0", "")[:30_000]
        return
    numbers = [n for n in NUMBERS if isinstance(n, float) or abs(n) < 2**63]
    texts = [t for t in TEXTS if "\0" not in t and "\ud800" not in t]
    create: Callable[[], Any] = rng.choice(
        (
            lambda: rng.choice(numbers),
            lambda: rng.choice(texts),
            lambda: np.full(rng.choice((0, 2, 3)), rng.choice((0.0, math.nan))),
            lambda: h5py.Empty("f4"),
            lambda: b"\xff\xfe raw",
            lambda: np.bytes_(b"\xff"),
            lambda: np.array([b"a", b"b"]),
        )
    )
    group.attrs[name] = create()


def _members(group: h5py.Group) -> list[str]:
    names: list[str] = []
    group.visit(names.append)
    return names


def _corrupt_member(group: h5py.Group, rng: Random) -> None:
    names = _members(group)
    if not names:
        return
    name = rng.choice(names)
    stored = group[name]
    is_numeric = isinstance(stored, h5py.Dataset) and stored.dtype.kind in "biuf" and 0 < (stored.size or 0) < 10**6
    array = stored[()] if is_numeric else np.zeros(3)
    del group[name]
    match rng.randrange(12):
        case 0:
            pass
        case 1:
            changed = np.array(array)
            if changed.dtype.kind == "f" and changed.size:
                changed.flat[rng.randrange(changed.size)] = rng.choice((math.nan, math.inf, 1e38))
            group[name] = changed
        case 2:
            kind = rng.choice(("f8", "i1", "i8", "u8", "f2", ">f4", "c8", "S5", "?"))
            group[name] = np.nan_to_num(array).astype(kind)
        case 3:
            group[name] = array[..., :1] if array.ndim > 1 else array.reshape(-1)[: array.size // 2]
        case 4:
            group[name] = rng.choice((np.zeros(()), np.zeros((0, 3), "f4"), array[None], array[..., None]))
        case 5:  # declares far more than it stores
            shape = rng.choice(((HUGE,), (2**40, *array.shape[1:]), (2**20, 2**20), (2**62,)))
            kind = array.dtype if array.dtype.kind in "fui" else "f4"
            group.create_dataset(name, shape, kind, chunks=tuple(min(n, 4) for n in shape))
        case 6:  # small on disk, large in memory
            big = np.zeros((rng.choice((2**22, 2**26)),), "u1")
            group.create_dataset(name, data=big, chunks=(2**20,), compression="gzip", compression_opts=1)
        case 7:
            group[name] = rng.choice(
                (h5py.SoftLink("/nowhere"), h5py.SoftLink("/"), h5py.ExternalLink("other.h5", "/x"))
            )
        case 8:
            group.create_group(name)
        case 9:
            group.create_dataset(name, (2,), h5py.string_dtype())
        case 10:
            group.create_dataset(name, (len(array) if array.ndim else 2,), h5py.vlen_dtype(np.float32))
        case 11:
            kind = np.dtype([("a", "f4"), ("b", "i4")])
            group.create_dataset(name, (3,), kind) if rng.random() < 0.5 else group.create_dataset(
                name, (4,), "u1", external=[("/etc/hostname", 0, 4)]
            )
