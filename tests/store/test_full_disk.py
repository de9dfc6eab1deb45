"""A disk that fills up at any write: one clear error, nothing sealed is lost, and it goes on."""

import resource
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from file_trees import bytes_of
from realsim.errors import RealsimError
from realsim.records import CameraIntrinsics, CaptureSession, View
from realsim.store import SessionStore, StorageError, atomic
from realsim.store.session_check import check_session
from refusals import refused

CAMERA = CameraIntrinsics(width=60, height=40, fx=60, fy=60, cx=29.5, cy=19.5)
SESSION = CaptureSession(name="full", intrinsics=CAMERA, depth_unit_m=1e-4)
PAGE = 4096
DISK_PAGES = 120


def add(store: SessionStore, index: int) -> None:
    rng = np.random.default_rng(index)
    rgb = rng.integers(0, 256, (40, 60, 3), dtype=np.uint8)
    counts = rng.integers(3000, 4000, (40, 60)).astype(np.uint16)
    store.add_view(View(index=index, joints=rng.normal(size=6)), rgb, depth_counts=counts)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 480 kB of its own."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK_PAGES * PAGE}", "tmpfs", str(folder)]
    try:
        subprocess.run(mount, check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"a small file system cannot be mounted here: {error}")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def sealed_bytes(folder: Path) -> dict[str, bytes]:
    return bytes_of(folder, "*/[!.]*.png")


def test_wherever_the_disk_fills_up_nothing_sealed_is_lost(disk: Path) -> None:
    # Law: for every number of free pages, the error is one, the views before are bit for bit as
    # they were, the store in hand and a newly opened one both go on when there is room again.
    ballast = disk / "ballast"
    failed_after = set[str]()
    for pages in range(0, 14, 3):
        folder = disk / f"s{pages}"
        store = SessionStore.create(folder, SESSION)
        for index in range(5):
            add(store, index)
        before, robot = sealed_bytes(folder), (folder / "robot.jsonl").read_bytes()
        ballast.write_bytes(b"\0" * (shutil.disk_usage(disk).free - pages * PAGE))
        index = 5
        with pytest.raises(StorageError) as told:
            while True:
                add(store, index)
                index += 1
        assert isinstance(told.value, RealsimError)
        assert "no room for view" in str(told.value) and "goes on from here" in str(told.value)
        assert not list(folder.rglob("*.part"))
        new_robot = (folder / "robot.jsonl").read_bytes()
        assert new_robot.startswith(robot) and new_robot.endswith(b"\n")
        assert {k: v for k, v in sealed_bytes(folder).items() if k in before} == before
        done = store.completed
        assert done >= set(range(index)) and len(done) <= index + 1
        assert check_session(folder).sound, check_session(folder).findings
        there = sealed_bytes(folder)
        failed_after.add("sealed" if index in done else f"{len(there) - 2 * index} images")
        ballast.unlink()
        if pages % 2:
            store = SessionStore.open(folder)
        for extra in range(max(done) + 1, max(done) + 3):
            add(store, extra)
        store = SessionStore.open(folder)
        assert store.completed == set(range(max(done) + 3))
        assert store.verify() == [] and check_session(folder, decode=True).findings == ()
        shutil.rmtree(folder)
    assert len(failed_after) >= 3, failed_after  # different writes were hit


def test_other_files_and_the_header_stay_as_they_were(disk: Path) -> None:
    folder = disk / "s"
    store = SessionStore.create(folder, SESSION)
    add(store, 0)
    store.write_json("reports/a.json", [1])
    ballast = disk / "ballast"
    ballast.write_bytes(b"\0" * shutil.disk_usage(disk).free)
    told, numbers = r"no room for reports/a\.json .* MB free", list(range(2000))
    refused(told, store.write_json, "reports/a.json", numbers, error=StorageError)
    refused("no room", SessionStore.create, disk / "t", SESSION, error=StorageError)
    ballast.unlink()
    assert store.read_json("reports/a.json") == [1] and store.verify() == []
    assert SessionStore.create(disk / "t", SESSION).completed == set()


@pytest.fixture
def longest_file() -> Iterator[None]:
    """Give the limit of a file's size back, whatever a test set."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.parametrize("name", ["robot.jsonl", "manifest.jsonl"])
def test_a_line_that_does_not_fit_leaves_no_half_line(
    tmp_path: Path, longest_file: None, name: str
) -> None:
    # The system writes 50 bytes of the line and refuses the rest, as a full disk does.
    store = SessionStore.create(tmp_path, SESSION)
    for index in range(60):
        add(store, index)
        path = tmp_path / name
        if path.stat().st_size > 12_000:
            break
    before = path.read_bytes()
    hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) + 50, hard))
    refused("File too large", add, store, 100, error=StorageError)
    refused("the removal of rgb/0", store.remove, "rgb/000000.png", error=StorageError)
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
    assert path.read_bytes() == before
    assert (100 in store.completed) == (name == "manifest.jsonl")
    add(store, 101)
    assert store.verify() == [] and check_session(tmp_path).sound
    is_listed = "rgb/000100.png" in (tmp_path / "manifest.jsonl").read_text()
    assert is_listed == (name == "manifest.jsonl")


def test_the_file_that_found_no_room_is_named(disk: Path) -> None:
    with pytest.raises(OSError) as told:
        atomic.write_bytes(disk / "new/page.html", b"0" * (DISK_PAGES + 1) * PAGE)
    assert told.value.filename == str(disk / "new/page.html")
    assert not list((disk / "new").iterdir())
