"""Strict JSON: serializable documents are read unchanged, others are rejected in one line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from beliefscope.app.workspace.json_files import read_record
from beliefscope.datasets.io.strict_json import read_json

REJECTED = {
    "NaN": "NaN is not a JSON number",
    '{"a": [-Infinity]}': "-Infinity is not a JSON number",
    "1e999": "not JSON compliant",
    "1" + "0" * 400: "401 digits",
    '{"a": ' + "-1" + "0" * 400 + "}": "402 digits",
    "9" * 5000: "digits",
    '"\\ud800"': "lone surrogate",
    '{"\\ud800": 1}': "lone surrogate",
    "[" * 200_000: "nested too deeply",
    "": "Expecting value",
}


@pytest.mark.parametrize("text", REJECTED, ids=lambda text: text[:12])
def test_invalid_json_is_rejected_in_one_line(text: str) -> None:
    with pytest.raises(ValueError, match=REJECTED[text]) as error:
        read_json(text)
    assert "\n" not in str(error.value)
    json.dumps(str(error.value), ensure_ascii=False).encode()


@pytest.mark.parametrize("value", [0, -1, 2**64, 10**308, -0.5, 1e-320, "é☃", [{}], {"": None}])
def test_valid_json_is_read_unchanged(value: object) -> None:
    assert read_json(json.dumps(value)) == value


def test_integers_never_become_infinity(tmp_path: Path) -> None:
    """Pydantic, which validates workspace files, would convert them."""
    path = tmp_path / "job.json"
    path.write_text("1" + "0" * 400)
    with pytest.raises(ValueError, match="401 digits"):
        read_record(float, path)
