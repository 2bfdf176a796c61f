"""Saved filters of a workspace: order in the catalog, and moved workspaces."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from beliefscope.app.runs.saved_filters import (
    SavedFilter,
    read_saved_filters,
    refresh_saved_filters,
    remove_filter,
    save_filter,
    with_saved_filters,
)
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.settings import Settings
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.runs.trace_worker import TraceWorker
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
    save_filter(store, saved(tmp_path, default=False))
    expected = [before[0], "tuned", *before[1:]]
    assert [*store.filters("push")] == names(with_saved_filters(settings)) == expected
    assert TraceStore(with_saved_filters(settings)).tasks() == TraceStore(settings).tasks()
    save_filter(store, saved(tmp_path, default=True))
    assert [*store.filters("push")] == names(with_saved_filters(settings)) == ["tuned", *before]
    save_filter(store, saved(tmp_path, default=False))
    assert [*store.filters("push")] == names(with_saved_filters(settings)) == expected


@pytest.mark.parametrize("default", [False, True])
def test_another_server_of_the_workspace_follows_the_list(tmp_path: Path, default: bool) -> None:
    store, other = TraceStore(Settings(tmp_path)), TraceStore(Settings(tmp_path))
    before = [*other.filters("push")]
    new = saved(tmp_path, default)
    save_filter(store, new)
    assert [*other.filters("push")] == before
    for _ in range(2):
        refresh_saved_filters(other)
        assert [*other.filters("push")] == [*store.filters("push")]
    Path(new.path).unlink()
    for server in (store, other):
        refresh_saved_filters(server)
        assert [*server.filters("push")] == before
        assert "tuned" not in server.settings.checkpoints


def test_a_filter_that_another_server_removed_is_not_listed(tmp_path: Path) -> None:
    """Its checkpoint is kept, and a filter of the same folder that was given to the server stays."""
    new = saved(tmp_path, default=True)
    given = {"mine": Path(shutil.copy(new.path, Path(new.path).with_name("copy.safetensors")))}
    store = TraceStore(Settings(tmp_path))
    save_filter(store, new)
    other = TraceStore(with_saved_filters(Settings(tmp_path, checkpoints=given)))
    third = TraceStore(Settings(tmp_path))
    refresh_saved_filters(third)
    remove_filter(store, "push", "tuned")
    for server, expected in ((other, ["mine"]), (third, [])):
        assert "tuned" in server.filters("push")
        server.checkpoint("push", "tuned")
        refresh_saved_filters(server)
        assert [*server.settings.checkpoints] == expected
        assert "tuned" not in server.filters("push")
        with pytest.raises(BadInput, match=r"filter 'tuned' was removed from the saved filters .* Available: "):
            server.checkpoint("push", "tuned")
    save_filter(store, new)
    refresh_saved_filters(other)
    assert other.checkpoint("push", "tuned").hash == store.checkpoint("push", "tuned").hash


def test_an_unreadable_list_removes_no_filter(tmp_path: Path) -> None:
    store = TraceStore(Settings(tmp_path))
    save_filter(store, saved(tmp_path, default=False))
    (tmp_path / "kept.json").write_text("[")
    refresh_saved_filters(store)
    assert "tuned" in store.filters("push")


def test_the_message_of_a_deleted_checkpoint_names_the_filter_and_the_next_step(tmp_path: Path) -> None:
    worker = TraceWorker()
    store = TraceStore(Settings(tmp_path), worker)
    new = saved(tmp_path, default=False)
    try:
        save_filter(store, new)
        worker.start()
        Path(new.path).unlink()
        with pytest.raises(BadInput, match=r"filter 'tuned' cannot run: .* was deleted or moved; reload the page"):
            store.request(Selection("push", "tuned", 0)).future.result(60.0)
    finally:
        store.close()


def test_a_damaged_checkpoint_of_another_server_is_not_listed(tmp_path: Path) -> None:
    store, other = TraceStore(Settings(tmp_path)), TraceStore(Settings(tmp_path))
    new = saved(tmp_path, default=False)
    save_filter(store, new)
    Path(new.path).write_bytes(b"damaged")
    refresh_saved_filters(other)
    assert "tuned" not in other.filters("push")


def test_a_workspace_may_be_moved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also one that was given as a relative path, as `serve` does by default."""
    monkeypatch.chdir(tmp_path)
    before = Path("before")
    save_filter(TraceStore(Settings(before)), saved(before, default=True))
    before.rename("after")
    monkeypatch.chdir("after")
    assert names(with_saved_filters(Settings(tmp_path / "after")))[0] == "tuned"
    (record,) = read_saved_filters(tmp_path / "after")
    assert Path(record.path) == tmp_path / "after" / "finetune" / "0123" / "finetuned.safetensors"
