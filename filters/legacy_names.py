"""Names that earlier versions wrote into files, and their present equivalents."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

SETTINGS = {"nominal": "clean_weight", "pull": "l2_sp", "moments": "events"}
"""Settings of a fine-tuning run."""

PLAN = {"pictures": "images", "alone": "single"}
"""Fields of a training schedule."""

SCORE = {"shown": "display_unit"}
"""Fields of a failure score, in the results of failure jobs."""

SLICES = {"nominal": "clean", "no contact": "free motion"}
"""Data slices. In addition, ``MODALITY alone`` is now ``MODALITY only``."""


def rename_keys(values: Mapping[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    """A copy with each old key replaced by the present one."""
    return {names.get(key, key): value for key, value in values.items()}


def failure_result(result: Mapping[str, Any]) -> dict[str, Any]:
    """The result of a failure job with present keys."""
    return {**result, "scores": [rename_keys(score, SCORE) for score in result["scores"]]}


def slice_name(name: str) -> str:
    """The present name of a data slice."""
    return f"{name.removesuffix(' alone')} only" if name.endswith(" alone") else SLICES.get(name, name)


def slice_json(value: Mapping[str, Any]) -> dict[str, Any]:
    """A data slice with present keys, and with its present name where it is one of the standard slices."""
    value = rename_keys(value, {"recipe": "faults"})
    name, only = value.get("name"), value.get("only")
    if isinstance(name, str) and (name in SLICES or (isinstance(only, list) and [name.removesuffix(" alone")] == only)):
        value["name"] = slice_name(name)
    return value


def training_record(record: Mapping[str, Any]) -> dict[str, Any]:
    """A checkpoint's record with present keys and slice names, such as ``base`` for ``parent``."""
    record = rename_keys(record, {"parent": "base", "looks": "validations", "recipe": "faults"})
    if isinstance(base := record.get("base"), Mapping) and isinstance(settings := base.get("settings"), Mapping):
        settings = rename_keys(settings, SETTINGS)
        if isinstance(mix := settings.get("mix"), list):
            settings["mix"] = [_slice_of(part) for part in mix]
        record["base"] = {**base, "settings": settings}
    if isinstance(validations := record.get("validations"), list):
        record["validations"] = [_rename_slices(validation, "slices") for validation in validations]
    for key in ("before", "after"):
        if "held_out" in record:
            record["held_out"] = _rename_slices(record["held_out"], key)
    return record


def _slice_of(part: Any) -> Any:
    if isinstance(part, Mapping) and isinstance(part.get("slice"), Mapping):
        return {**part, "slice": slice_json(part["slice"])}
    return part


def _rename_slices(document: Any, key: str) -> Any:
    if not isinstance(document, Mapping) or not isinstance(document.get(key), Mapping):
        return document
    return {**document, key: {slice_name(name): value for name, value in document[key].items()}}
