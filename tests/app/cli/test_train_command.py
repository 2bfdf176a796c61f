"""``beliefscope train``: the filters that it can train."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from beliefscope.datasets.store import open_dataset, sample_path, write_dataset
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.filters.training.train import Trained

Run = Callable[..., tuple[int, str, str]]

TRAINED = "Filters that can be trained: crossmodal-ekf, crossmodal-pf, crossmodal-ukf, information-ekf, "
FINETUNE = "beliefscope finetune door --filter own.py:make -o finetuned.safetensors"


@pytest.mark.parametrize(
    ("filter_", "problem"),
    [
        ("own.py", f"is an external filter, which this command does not train; fine-tune it: {FINETUNE}"),
        ("own.py:make", f"is an external filter, which this command does not train; fine-tune it: {FINETUNE}"),
        ("package.module:build", "is an external filter, which this command does not train; fine-tune it: "),
        ("absent.py", "is not a filter that this command trains, and no file 'absent.py' exists. "),
        ("absent.py:build", "is not a filter that this command trains, and no file 'absent.py' exists. "),
        ("absent.safetensors", "is not a filter that this command trains, and no file 'absent.safetensors' exists. "),
        ("./notes.txt", "is not a filter that this command trains. "),
        ("a.safetensors", "is a checkpoint; fine-tune it: beliefscope finetune a.safetensors -o finetuned.safetensors"),
    ],
)
def test_what_is_no_filter_to_train_is_named_with_the_command_for_it(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, filter_: str, problem: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text("def make():\n    raise AssertionError\n")
    for name in ("notes.txt", "a.safetensors"):
        (tmp_path / name).write_text("")
    code, out, error = run("train door --filter", filter_, "-o", tmp_path / "new.safetensors")
    assert (code, out) == (2, "")
    assert error.startswith(f"error: filter {filter_!r} {problem}")
    assert TRAINED in error


def test_an_unknown_name_lists_the_names_only(run: Run, tmp_path: Path) -> None:
    code, _, error = run("train door --filter crosmodal-ekf", "-o", tmp_path / "new.safetensors")
    assert code == 2
    assert error.startswith("error: filter 'crosmodal-ekf' does not exist. Did you mean crossmodal-ekf")


def test_other_commands_name_a_missing_file_of_a_filter(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "absent.py"
    code, _, error = run("trace door --filter", path, "-o", tmp_path / "run.trace")
    assert code == 2
    assert error.startswith(f"error: filter '{path}' does not exist: expected a file and its function, such as ")


@pytest.mark.long
@pytest.mark.slow
def test_the_healthy_record_over_a_sample_set_uses_the_images_of_its_camera(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = load_checkpoint(pretrained_path("push", "haptics-ekf"))
    given: list[bool] = []
    monkeypatch.setattr(
        "beliefscope.filters.training.train.train", lambda *_, **__: Trained(base.filter, dict(base.record))
    )
    monkeypatch.setattr("beliefscope.inspect.healthy.measure_profile", lambda *arguments: given.append(arguments[4]))
    assert run("train push --filter haptics-ekf -o", tmp_path / "new.safetensors")[0] == 0
    assert given == [True]
    with open_dataset(sample_path("push")) as data:
        write_dataset(tmp_path / "few.h5", data.task, [data[i] for i in (0, 9, 19)])  # the first is of training
    _, _, error = run("train push --filter haptics-ekf --data", tmp_path / "few.h5", "-o", tmp_path / "few.safetensors")
    assert "Warning: the data have 2 held-out episodes; diagnose needs a healthy record of at least 10" in error
