"""Files that come back from another machine: all of them or none, and never out of their folder."""

import errno

import pytest

from realsim.many import Sent, Worked
from realsim.many.carried import Incoming, Piece, digest_of, packed
from realsim.store import atomic
from realsim.store.atomic import StorageError
from refusals import refused


def test_nothing_is_there_before_everything_has_come(tmp_path):
    (tmp_path / "gone").write_bytes(b"old")
    (tmp_path / "kept").write_bytes(b"old")
    incoming = Incoming(tmp_path)
    incoming.take(Piece("kept", b"ne", is_first=True, is_last=False))
    incoming.take(Piece("kept", b"w", is_first=False, is_last=True))
    incoming.take(Piece("below/new", b"", is_first=True, is_last=True))
    assert (tmp_path / "kept").read_bytes() == b"old" and not (tmp_path / "below/new").exists()
    incoming.commit(("gone",))
    found = {p.relative_to(tmp_path).as_posix(): p.read_bytes() for p in tmp_path.rglob("*.*")}
    assert not found and not (tmp_path / "gone").exists()
    assert (tmp_path / "kept").read_bytes() == b"new" and (tmp_path / "below/new").is_file()


def test_what_is_dropped_leaves_no_trace(tmp_path):
    incoming = Incoming(tmp_path)
    incoming.take(Piece("a", b"1", is_first=True, is_last=True))
    assert list(tmp_path.iterdir())
    incoming.drop()
    assert not list(tmp_path.iterdir())


def test_a_full_disk_here_is_told_and_nothing_is_changed(tmp_path, monkeypatch):
    (tmp_path / "a").write_bytes(b"old")
    incoming = Incoming(tmp_path)

    def full(handle):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    piece = Piece("a", b"new", is_first=True, is_last=True)
    refused(r"no room for 'a'.*goes on from here", incoming.take, piece, error=StorageError)
    incoming.drop()
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == {"a": b"old"}


@pytest.mark.parametrize("name", ["../a", "/etc/a", "b/../../a"])
def test_a_path_that_leads_out_is_refused(name, tmp_path):
    piece = Piece(name, b"1", is_first=True, is_last=True)
    refused("leads out of its folder", Incoming(tmp_path).take, piece)
    refused("leads out of its folder", Incoming(tmp_path).commit, (name,))


def test_files_are_named_by_their_bytes_and_leftovers_stay_behind(tmp_path):
    folder = tmp_path / "s"
    for name in ("a/x", "b/x", "b/y"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(name[-1:].encode())
    atomic.temporary(folder / "b/z").write_bytes(b"half")
    ((all_of_it, part), needed, worked) = packed((Sent(folder), Worked(folder, ("b/*",))), tmp_path)
    assert [name for name, _ in all_of_it.files] == ["a/x", "b/x", "b/y"]
    assert [name for name, _ in part.files] == ["b/x", "b/y"] and part.is_worked
    assert len(needed) == 2 and worked == [Worked(folder, ("b/*",))]
    assert all(digest_of(path) == digest for digest, path in needed.items())
    before = digest_of(folder / "a/x")
    (folder / "a/x").write_bytes(b"changed")
    assert digest_of(folder / "a/x") != before


def test_what_is_not_there_and_two_changed_folders_are_refused(tmp_path):
    refused("is not there, and a job needs it", packed, (Sent(tmp_path / "none"),), tmp_path)
    refused("one folder at most; it names 2", packed, (Worked(tmp_path),) * 2, tmp_path)
