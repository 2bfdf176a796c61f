"""The command ``change`` with external filters of a task without contact."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

import pytest

pytestmark = pytest.mark.slow

CODE = """
import sys

import numpy as np

import beliefscope as bs

TASK = bs.Task(
    name="cart",
    components=(bs.Component("x", "m"),),
    observations={"encoder": (1,), "beacon": (1,)},
    modalities={"encoder": ("encoder",), "beacon": ("beacon",)},
    control_size=0,
    dt=0.1,
    map_half_width=1.0,
    covariates={"slip": bs.Covariate("boolean")},
)


def episode(seed):
    rng = np.random.default_rng(seed)
    x = np.cumsum(rng.normal(0, 0.1, (20, 1)), axis=0)
    observations = {key: x + rng.normal(0, std, x.shape) for key, std in (("encoder", 0.05), ("beacon", 0.5))}
    slip = {"slip": (np.arange(20) > 10).astype(np.float32)}
    return bs.Episode(TASK, x, observations=observations, covariates=slip, seed=seed)


def encoder():
    return bs.Adapter(lambda observations, controls: observations["encoder"], task=TASK)


def beacon():
    return bs.Adapter(lambda observations, controls: observations["beacon"], task=TASK)


if __name__ == "__main__":
    bs.save_dataset([episode(seed) for seed in range(10)], "cart.h5")
"""


def reversed_filters(change: tuple[str, ...]) -> tuple[str, ...]:
    return (change[0], change[2], change[1], *change[3:])


@pytest.mark.long
def test_report_names_filters_and_removed_sensors(
    run: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("cart.py").write_text(CODE)
    exec(compile(CODE, "cart.py", "exec"), {"__name__": "__main__"})
    change = ("change", "cart.py:encoder", "cart.py:beacon", "--data", "cart.h5")
    code, out, _ = run(*change, "-o", "report")
    assert code == 0
    assert out.startswith("Before: cart-encoder; after: cart-beacon; 10 episodes")
    assert Path("report/change.md").read_text() == f"```\n{out.strip()}\n```\n"
    assert out.count("A removed sensor reads its mean over the episode") == 1
    assert "Regressed events" in out
    assert "contact" not in out, "a column of a task without contact"
    event = json.loads(Path("report/change.json").read_text())["events"][0]
    query = parse_qs(event["link"].removeprefix("?"))
    assert query["filter"] == ["cart-beacon"]
    code, out, error = run(*change, "--fail-on-regression", "--json", "-")
    assert (code, error.splitlines()[-1]) == (1, "regressed: clean")
    document = json.loads(out)
    assert document["regressed_slices"] == ["clean"]
    assert "; regressed: clean: x " in document["verdict"]
    assert run(*reversed_filters(change), "--fail-on-regression")[0] == 0
    code, out, _ = run("change", "cart.py:encoder", "cart.py:encoder", "--data", "cart.h5")
    assert (code, out.startswith("Before: cart.py:encoder; after: cart.py:encoder")) == (0, True)
    code, _, error = run(*change, "--slice", "slip")
    assert (code, "slices select steps by contact only, not by 'slip'; a sweep has" in error) == (2, True)
