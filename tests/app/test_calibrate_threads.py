"""`realsim calibrate` keeps BLAS to one thread: several wait for each other on small matrices."""

from pathlib import Path

from threadpoolctl import threadpool_info, threadpool_limits

from realsim.app.calibrate import run
from realsim.app.console import Console


def test_blas_has_one_thread_while_it_calibrates(monkeypatch, tmp_path):
    seen = []

    def look(source: Path, console: Console, **options: object) -> bool:
        seen.extend(lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas")
        return True

    monkeypatch.setattr(run, "_run", look)
    with threadpool_limits(2, user_api="blas"):
        assert run.run_calibrate(tmp_path, Console(quiet=True), live=False)
    assert seen and set(seen) == {1}
