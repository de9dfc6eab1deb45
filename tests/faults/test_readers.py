"""The table of readers is the code's; damaged files of our own are read or refused."""

import errno
import importlib
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from realsim.errors import UnreadableError
from refusals import refused

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "benchmarks"))
mutations: Any = importlib.import_module("formats_mutations")
worker: Any = importlib.import_module("formats_mutations_worker")
own: Any = importlib.import_module("reliability_own")
logs: Any = importlib.import_module("reliability_log")

ROW = re.compile(r"^\| [^|]+ \| `([\w.]+)\.([A-Z_]+)` \| (\d+) \|$", re.M)
TABLE = ROW.findall((ROOT / "docs/reliability.md").read_text())


def test_the_limits_are_those_of_the_code() -> None:
    assert len(TABLE) >= 30
    for module, name, value in TABLE:
        assert getattr(importlib.import_module(module), name) == int(value), (module, name)


def test_every_reader_of_untrusted_files_is_in_the_table() -> None:
    listed = {module for module, _, _ in TABLE}
    for file in (ROOT / "realsim/untrusted").glob("*.py"):
        if re.search(r"^MOST_", file.read_text(), re.M):
            assert f"realsim.untrusted.{file.stem}" in listed, file.name


@pytest.mark.parametrize("sample", own.OWN, ids=lambda s: s.name)
def test_damaged_files_of_our_own_are_read_or_refused(sample: Any) -> None:
    files = worker.sample_files(sample)

    @example(seed=7339)  # a session whose table of camera poses is a list
    @given(seed=st.integers(0, 2**31))
    @settings(max_examples=25, deadline=None, database=None)
    def holds(seed: int) -> None:
        found = worker.read_mutation(sample, files, seed, frozenset())
        assert found.kind in mutations.RIGHT, found

    holds()


def test_a_usd_file_at_which_the_library_breaks_down_is_refused() -> None:
    pytest.importorskip("pxr")
    found = mutations.replay("mesh usdc", 32_000_140)
    assert found.kind == "refused" and "damaged" in found.detail


@pytest.mark.slow
def test_a_usd_file_for_which_the_library_takes_gigabytes_is_refused_with_less() -> None:
    pytest.importorskip("pxr")
    # What a process took before it became this one counts in its own `ru_maxrss`.
    script = (
        "import resource as r, formats_mutations as m; o = m.replay('mesh usdc', 28_900_964);"
        "own = open('/proc/self/status').read().split('VmHWM:')[1].split()[0];"
        "print(o.kind, max(int(own), r.getrusage(r.RUSAGE_CHILDREN).ru_maxrss) >> 10)"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=Path(mutations.__file__).parent,
                          capture_output=True, text=True, check=True)  # fmt: skip
    kind, peak_mb = done.stdout.split()
    assert kind == "refused" and int(peak_mb) < 1500  # without a bound 2300


@pytest.mark.parametrize(("name", "seed", "kind"), [
    ("graspit", 11_900_056, "read"),  # no grasps beside it
    ("graspit", 12_300_180, "read"),  # 5000 letters name the file of grasps
    ("colmap binary", 7_900_213, "refused"),  # an image's name is no text
    ("results of a session", 33_900_205, "refused"),  # a trajectory's time is NaN
    ("kept files", 37_700_283, "refused"),  # a whole number of a sensor has hundreds of digits
])  # fmt: skip
def test_what_was_found_once_stays_read_or_refused(name: str, seed: int, kind: str) -> None:
    assert mutations.replay(name, seed).kind == kind


def test_a_log_that_was_cut_off_keeps_its_whole_lines_and_goes_on(tmp_path: Path) -> None:
    first = logs.Log(tmp_path / "log")
    for k, wrong in ((0, 1), (2, 0), (0, 0), (3, 0)):
        first.add("typed", 5, k, traceback=wrong)
    (tmp_path / "log").write_text((tmp_path / "log").read_text()[:-5])
    logs.Log(tmp_path / "log").add("typed", 6, 0)
    log = logs.Log(tmp_path / "log")
    assert [line["key"] for line in log.of("typed")] == [[5, 0], [5, 2], [6, 0]]
    assert log.of("typed")[0]["traceback"] == 0  # what was measured again
    assert [*log.todo("typed", 5, 4)] == [1, 3]


@pytest.mark.parametrize("reader", [
    "realsim.images read_rgb", "realsim.images image_size", "realsim.untrusted.arrays read_npy",
    "realsim.formats.folders.listing image_header", "realsim.models.mesh_loading load_pieces",
    "realsim_calibration.inputs.image_files load_image", "realsim.store.header header_to_open",
    "realsim.untrusted.own_json read_values",
])  # fmt: skip
def test_a_file_that_may_not_be_read_is_not_called_damaged(
    reader: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def denied(path: Path, *how: Any, **more: Any) -> Any:
        if path != file:
            return opened(path, *how, **more)
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    opened, file = Path.open, tmp_path / "file.ply"
    file.write_bytes(b"whatever")
    monkeypatch.setattr(Path, "open", denied)  # the administrator, who may be testing, may read all
    module, name = reader.split()
    read = getattr(importlib.import_module(module), name)
    refused("^you may not read .*file.ply: its permissions", read, file, error=UnreadableError)
