"""Saved filters of a workspace: order in the catalog, several servers, and moved workspaces."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from beliefscope.app.runs.settings import Settings
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.workspace.saved_filters import SavedFilter, SavedFilters
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation.push import PUSH
from beliefscope.filters.checkpoint import pretrained_path

pytestmark = pytest.mark.slow


def saved(workspace: Path, default: bool) -> SavedFilter:
    """A copy of a pretrained filter as the result of a run."""
    path = workspace / "finetune" / "0123" / "finetuned.safetensors"
    path.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(pretrained_path(PUSH, "crossmodal-ekf"), path)
    return SavedFilter("push", "tuned", str(path), default)


def names(settings: Settings) -> list[str]:
    return [*TraceStore(settings).filters("push")]


def test_a_saved_filter_is_listed_after_the_default_one(tmp_path: Path) -> None:
    settings = Settings(tmp_path)
    before, store = names(settings), TraceStore(settings)
    store.saved.save(saved(tmp_path, default=False))
    expected = [before[0], "tuned", *before[1:]]
    assert [*store.filters("push")] == names(settings) == expected
    store.saved.save(saved(tmp_path, default=True))
    assert [*store.filters("push")] == names(settings) == ["tuned", *before]
    store.saved.save(saved(tmp_path, default=False))
    assert [*store.filters("push")] == names(settings) == expected


@pytest.mark.parametrize("default", [False, True])
def test_another_server_of_the_workspace_follows_the_list(tmp_path: Path, default: bool) -> None:
    """Also where the checkpoint is deleted, and with a filter of the same folder that was given to the server."""
    new = saved(tmp_path, default)
    given = {"mine": Path(shutil.copy(new.path, Path(new.path).with_name("copy.safetensors")))}
    store, other = TraceStore(Settings(tmp_path)), TraceStore(Settings(tmp_path, checkpoints=given))
    before = [*store.filters("push")]
    store.saved.save(new)
    assert "tuned" in store.filters("push")
    assert other.checkpoint("push", "tuned").hash == store.checkpoint("push", "tuned").hash
    store.saved.remove("push", "tuned")
    for server, expected in ((other, ["mine", *before]), (store, before)):
        assert [*server.filters("push")] == expected
        with pytest.raises(BadInput, match=r"filter 'tuned' does not exist"):
            server.checkpoint("push", "tuned")
    store.saved.save(new)
    Path(new.path).write_bytes(b"damaged")
    assert [*store.filters("push")] == before
    Path(new.path).unlink()
    assert [*store.filters("push")] == before


def test_an_unreadable_list_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "kept.json").write_text("[")
    filters = SavedFilters(tmp_path)
    assert filters.all() == []
    with pytest.raises(BadInput, match=r"kept.json' is damaged .* move it away"):
        filters.save(saved(tmp_path, default=False))


def test_a_workspace_may_be_moved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also one that was given as a relative path, as `serve` does by default."""
    monkeypatch.chdir(tmp_path)
    before = Path("before")
    SavedFilters(before).save(saved(before, default=True))
    before.rename("after")
    monkeypatch.chdir("after")
    assert names(Settings(tmp_path / "after"))[0] == "tuned"
    (record,) = SavedFilters(tmp_path / "after").all()
    assert Path(record.path) == tmp_path / "after" / "finetune" / "0123" / "finetuned.safetensors"
