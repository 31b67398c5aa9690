# SPDX-License-Identifier: Apache-2.0
import json
import os
import resource
import signal
import sys
import warnings
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
import torch
from safetensors.torch import load_file

from blitzgs.distributed.group import Ranks
from blitzgs.runs import checkpoint, checkpoint_files, trained_model
from tests.distributed.rank_harness import CONTEXT, all_fail, run_ranks
from tests.helpers import refused, save_checkpoint
from tests.training.tiny import assert_same_table, random_gaussians, sorted_rows, tiny_config

ALONE = Ranks()


def table(rows, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return {
        "means": torch.randn(rows, 3, generator=generator),
        "sh": torch.randn(rows, 4, 3, generator=generator),
        "opacities": torch.randn(rows, generator=generator),
        "id": torch.randperm(rows, generator=generator),
        "level": torch.randint(0, 5, (rows,), generator=generator, dtype=torch.uint8),
        "flag": torch.rand(rows, generator=generator) > 0.5,
        "last_step": torch.randint(0, 99, (rows,), generator=generator, dtype=torch.int32),
    }


def latest(directory, ranks=ALONE):
    found = checkpoint.newest(directory, ranks, lambda path: checkpoint.load(path, ranks, "cpu"))
    return found and found[0]


def test_round_trip_and_format(tmp_path):
    columns, state = table(101), {"iteration": 7, "note": ["ä", 1.5, None]}
    path = save_checkpoint(tmp_path / "checkpoints", columns, state, ALONE)
    loaded = latest(tmp_path / "checkpoints")
    assert_same_table(loaded.columns, columns)
    assert loaded.state == state
    assert checkpoint.newest(path.parent, ALONE, str) == (str(path), path, [])
    # The shard is an ordinary safetensors file.
    assert_same_table(load_file(path / "shard_0000_of_0001.safetensors"), columns)
    assert latest(tmp_path / "nothing here") is None
    empty = table(0)
    save_checkpoint(tmp_path / "checkpoints", empty, state, ALONE)
    assert_same_table(latest(tmp_path / "checkpoints").columns, empty)


@pytest.mark.parametrize("first", [0, 1_000_000])
def test_keeps_the_last_k(tmp_path, first):
    if first > 0:
        (tmp_path / f"checkpoint_{first - 1}").mkdir()
    for number in range(first, first + 5):
        path = save_checkpoint(tmp_path, table(3), {"iteration": number}, ALONE, keep=2)
        assert path.name == f"checkpoint_{number:06d}"
    assert {p.name for p in tmp_path.iterdir()} == {f"checkpoint_{first + k:06d}" for k in (3, 4)}
    assert latest(tmp_path).state == {"iteration": first + 4}


def _flip_bit(path, offset):
    data = bytearray(path.read_bytes())
    data[offset] ^= 0x10
    path.write_bytes(data)


def _seal(path, shard=None, rows=None):
    """Give a checkpoint other content, with the digests that belong to it."""
    manifest = checkpoint_files.read_manifest(path)
    (about,) = manifest.shards
    file = path / about.file
    file.write_bytes(shard or file.read_bytes())
    digest = checkpoint_files.file_digest(file)
    about.rows, about.bytes, about.sha256 = rows or about.rows, file.stat().st_size, digest
    path.rename(path.with_name("other"))
    checkpoint_files.finish(path.with_name("other"), path, manifest)


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda p: _seal(p, shard=b"no safetensors" * 9), "deserializing header"),
        (lambda p: _seal(p, rows=49), "columns of other lengths than the manifest's 49"),
        (lambda p: _seal(p, rows="many"), "columns of other lengths than the manifest's many"),
        (lambda p: _flip_bit(p / "shard_0000_of_0001.safetensors", 700), "does not match its SHA-256"),
        (lambda p: _flip_bit(p / "shard_0000_of_0001.safetensors", 9), "does not match its SHA-256"),
        (lambda p: os.truncate(p / "shard_0000_of_0001.safetensors", 500), "has 500 bytes"),
        (lambda p: (p / "shard_0000_of_0001.safetensors").unlink(), "safetensors is missing"),
        (lambda p: (p / "manifest.json").unlink(), "manifest.json is missing"),
        (lambda p: os.truncate(p / "manifest.json", 40), "not valid JSON"),
        (lambda p: (p / "manifest.json").write_text(json.dumps({"format": 9})), "format 9"),
        (lambda p: (p / "manifest.json").write_text('{"format": 1, "shards": [], "state": {}}'), "no files"),
        (lambda p: (p / "manifest.json").write_text("[" * 5000), "recursion"),
    ],
)
def test_a_damaged_checkpoint_is_refused_by_name(tmp_path, damage, reason):
    save_checkpoint(tmp_path, table(50, 1), {"iteration": 1}, ALONE)
    newest = save_checkpoint(tmp_path, table(50, 2), {"iteration": 2}, ALONE)
    damage(newest)
    with pytest.warns(
        UserWarning, match=f"checkpoint_000001 is damaged.*{reason}.*; using checkpoint_000000"
    ):
        loaded = latest(tmp_path)
    assert loaded.state == {"iteration": 1}
    assert_same_table(loaded.columns, table(50, 1))
    with pytest.raises(checkpoint.CheckpointError, match=f"checkpoint_000001 is damaged.*{reason}"):
        checkpoint.load(newest, ALONE, "cpu")
    # A new save does not reuse the damaged one's name.
    assert save_checkpoint(tmp_path, table(5), {}, ALONE).name == "checkpoint_000002"


def test_each_damaged_checkpoint_is_named_once(tmp_path):
    paths = [save_checkpoint(tmp_path, table(5), {}, ALONE) for _ in range(3)]
    for path in paths[1:]:
        (path / "manifest.json").unlink()
    with pytest.warns(UserWarning) as caught:
        latest(tmp_path)
    (warning,) = caught
    (paths[0] / "manifest.json").unlink()
    with (
        warnings.catch_warnings(),
        pytest.raises(checkpoint.CheckpointError, match="no sound checkpoint") as failure,
    ):
        warnings.simplefilter("error")
        latest(tmp_path)
    for path in paths:
        assert str(warning.message).count(path.name) == 1
        assert str(failure.value).count(path.name) == 1


def test_a_checkpoint_that_is_replaced_while_it_is_read_is_not_damaged(tmp_path):
    old = save_checkpoint(tmp_path, table(5), {"iteration": 1}, ALONE, keep=1)

    def read(path):
        if path == old:  # as slow as a training that meanwhile saves its next checkpoint
            save_checkpoint(tmp_path, table(5), {"iteration": 2}, ALONE, keep=1)
        return checkpoint.load(path, ALONE, "cpu")

    assert checkpoint.newest(tmp_path, ALONE, read)[0].state == {"iteration": 2}
    with pytest.raises(checkpoint.CheckpointError, match="no checkpoint 'last'; it has checkpoint_000001$"):
        checkpoint.newest(tmp_path, ALONE, read, "last")


def _save_and_die(directory, calls):
    """Save, and end before call number `calls` of the system that makes, names or syncs a file or folder."""
    left = iter(range(calls))

    def count():
        if next(left, None) is None:
            os.kill(os.getpid(), signal.SIGKILL)

    def look(event, arguments):
        made = event == "open" and isinstance(arguments[1], str) and set(arguments[1]) & {"w", "x"}
        if (made or event in ("os.mkdir", "os.rename")) and str(directory) in str(arguments[0]):
            count()

    fsync = os.fsync
    os.fsync = lambda descriptor: (count(), fsync(descriptor))
    sys.addaudithook(look)
    save_checkpoint(directory, table(64, 2), {"iteration": 2}, ALONE, keep=2)


def test_kill_at_any_point_of_a_save(tmp_path):
    found, exitcode = [], -signal.SIGKILL
    while exitcode == -signal.SIGKILL:
        directory = tmp_path / str(len(found))
        save_checkpoint(directory, table(64, 0), {"iteration": 0}, ALONE)
        save_checkpoint(directory, table(64, 1), {"iteration": 1}, ALONE)
        process = CONTEXT.Process(target=_save_and_die, args=(directory, len(found)))
        process.start()
        process.join(60)
        exitcode = process.exitcode
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            loaded = latest(directory)
        found.append(loaded.state["iteration"])
        assert_same_table(loaded.columns, table(64, found[-1]))
        # The next save clears what was left behind.
        save_checkpoint(directory, table(4), {}, ALONE, keep=2)
        assert len(list(directory.iterdir())) == 2
    # There from the new name on: before its folder is synced, before an older one is renamed, and at the end.
    assert exitcode == 0 and found == [1] * (len(found) - 3) + [2] * 3 and len(found) >= 10


def _save_on_a_full_disk(directory, limit):
    # Past the limit every write fails; Python ignores the signal that comes with it.
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    try:
        save_checkpoint(directory, table(5000, 1), {"iteration": 1}, ALONE)
    except checkpoint.CheckpointError as error:
        (directory / "message").write_text(str(error))


def test_full_disk(tmp_path, monkeypatch):
    save_checkpoint(tmp_path, table(64), {"iteration": 0}, ALONE)
    process = CONTEXT.Process(target=_save_on_a_full_disk, args=(tmp_path, 100_000))
    process.start()
    process.join(60)
    message = (tmp_path / "message").read_text()
    assert "checkpoint_000001 was not saved: rank 0 could not write: a file is larger than" in message
    assert sorted(p.name for p in tmp_path.iterdir()) == ["checkpoint_000000", "message"]
    usage = type("Usage", (), {"free": 10})
    monkeypatch.setattr(checkpoint.shutil, "disk_usage", lambda path: usage)
    with pytest.raises(checkpoint.CheckpointError, match="[kM]B are needed and .* are free") as failure:
        save_checkpoint(tmp_path, table(64), {}, ALONE)
    assert failure.value.lacks_space
    assert latest(tmp_path).state == {"iteration": 0}


def _refuse(monkeypatch, method, folder):
    original = getattr(checkpoint.Path, method)

    def refused(path, *arguments):
        if path == folder:
            raise PermissionError(1, "Operation not permitted", str(path))
        return original(path, *arguments)

    monkeypatch.setattr(checkpoint.Path, method, refused)


def test_an_old_checkpoint_that_cannot_be_deleted_is_named_and_stays(tmp_path, monkeypatch):
    for iteration in range(2):
        save_checkpoint(tmp_path, table(3), {"iteration": iteration}, ALONE, keep=2)
    with monkeypatch.context() as patch:
        _refuse(patch, "rename", tmp_path / "checkpoint_000000")
        with pytest.warns(UserWarning, match="could not be deleted.*not permitted.*checkpoint_000000"):
            save_checkpoint(tmp_path, table(3), {"iteration": 2}, ALONE, keep=2)
    assert latest(tmp_path).state == {"iteration": 2}
    save_checkpoint(tmp_path, table(3), {"iteration": 3}, ALONE, keep=2)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["checkpoint_000002", "checkpoint_000003"]


def test_a_folder_that_cannot_be_read_is_a_failed_checkpoint(tmp_path, monkeypatch):
    save_checkpoint(tmp_path, table(3), {}, ALONE)
    _refuse(monkeypatch, "iterdir", tmp_path)
    with pytest.raises(checkpoint.CheckpointError, match=f"could not read {tmp_path}"):
        save_checkpoint(tmp_path, table(3), {}, ALONE)


def _save_shard(ranks, directory, sizes):
    begin, end = (sum(sizes[:rank]) for rank in (ranks.rank, ranks.rank + 1))
    shard = {name: column[begin:end] for name, column in table(sum(sizes)).items()}
    return save_checkpoint(directory, shard, {"m": 4}, ranks).name


def _load_shard(ranks, directory):
    loaded = latest(directory, ranks)
    return loaded.columns, loaded.state


def _save_with_one_full_disk(ranks, directory, sizes):
    if ranks.rank == 1:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
    return _save_shard(ranks, directory, sizes)


def test_save_at_four_ranks_load_at_any_number(tmp_path):
    sizes = [30, 0, 11, 60]
    assert run_ranks(_save_shard, 4, tmp_path, sizes) == ["checkpoint_000000"] * 4
    whole = sorted_rows(table(sum(sizes)))
    for world_size in (1, 2, 3, 4):
        answers = run_ranks(_load_shard, world_size, tmp_path)
        shards = [columns for columns, _ in answers]
        assert all(state == {"m": 4} for _, state in answers)
        together = {name: torch.cat([shard[name] for shard in shards]) for name in whole}
        assert_same_table(sorted_rows(together), whole)
        lengths = [len(shard["id"]) for shard in shards]
        if world_size == 4:
            assert lengths == sizes  # as saved
        else:
            assert max(lengths) - min(lengths) <= 1
    text = "checkpoint_000001 was not saved: rank 1 could not write: a file is larger than"
    all_fail(text, _save_with_one_full_disk, tmp_path, [50, 50])
    assert [p.name for p in tmp_path.iterdir()] == ["checkpoint_000000"]


def test_dealing_keeps_the_order_and_opens_only_what_it_needs(tmp_path):
    whole = table(22)
    four = [{name: column[m::4] for name, column in whole.items()} for m in range(4)]
    # Four shards of a table dealt round-robin, written one by one.
    shards = []
    for m, columns in enumerate(four):
        file = tmp_path / f"{m}.safetensors"
        size, digest = checkpoint.write_shard(file, columns)
        shards.append(checkpoint_files.Shard(file.name, len(columns["id"]), size, digest))
    assert_same_table(checkpoint.read_share(tmp_path, shards, ALONE, torch.device("cpu")), whole)
    # Rows 1, 3, 5, ... are in the second and the fourth file; of the first, only the header is read.
    first = tmp_path / shards[0].file
    first.write_bytes(first.read_bytes()[:-1])
    (tmp_path / shards[2].file).unlink()
    share = checkpoint.read_share(tmp_path, shards, Ranks(rank=1, world_size=2), torch.device("cpu"))
    assert_same_table(share, {name: column[1::2] for name, column in whole.items()})


def test_shared_columns_are_saved_and_checked(tmp_path):
    shared = {"costs": torch.rand(7), "views": torch.arange(3), "none": torch.empty(0, 4)}
    path = save_checkpoint(tmp_path, table(5), {}, ALONE, shared=shared)
    assert_same_table(latest(tmp_path).shared, shared)
    _flip_bit(path / checkpoint.SHARED, -1)
    refused(checkpoint.CheckpointError, "shared.* not match its SHA-256", checkpoint.load, path, ALONE, "cpu")
    (path / checkpoint.SHARED).unlink()
    refused(checkpoint.CheckpointError, "shared.safetensors is missing", checkpoint.load, path, ALONE, "cpu")


@pytest.mark.parametrize(("ranks", "copies"), [(1, True), (2, True), (3, False)])
def test_ranks_that_share_a_memory_need_room_for_all_their_copies(tmp_path, monkeypatch, ranks, copies):
    gaussians, written = random_gaussians(), []
    job = SimpleNamespace(world_size=ranks, watchdog=SimpleNamespace(working=lambda what: nullcontext()))
    monkeypatch.setattr(trained_model, "check_before_saving", lambda *_: None)
    monkeypatch.setattr(trained_model, "available_bytes", lambda: 5 * gaussians.memory_bytes)
    monkeypatch.setattr(
        checkpoint, "Saving", lambda folder, columns, *_: written.append(columns) or SimpleNamespace(wait=int)
    )
    progress, space = trained_model.Progress(1, 0, 1, 1, 0.0), trained_model.Space((0.0, 0.0, 0.0), 1.0, 1.0)
    model = trained_model.TrainedModel(tiny_config(), progress, space, gaussians)
    trained_model.save(tmp_path, model, job, in_background=True)
    assert (written[0]["means"].data_ptr() != gaussians["means"].data_ptr()) == copies
