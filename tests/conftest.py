"""Sessions that all tests of a run share: each is made once, by the process that asks first.

Tests that only read use the folder as it is. A test that writes takes a copy:

    from shared_sessions import copy_of
    session = copy_of(registered_session, tmp_path / "session")

- `run_folder`: one folder for all processes of a run, for further ones (`shared_sessions.once`).
- `small_session`: six views of 40x30, a plan, camera poses, board views inside (stored_sessions).
- `table_views`: rendered depth of a mug and a wedge, eight views of 320x240, models, nothing
  registered (registered_sessions.table_session).
- `registered_session`: the same with a registration that is the truth.
- `demo_session`: a whole `realsim demo` of six views, two objects, eight grasps each: captured,
  calibrated, registered, schooled, annotated, reported. It costs about 50 CPU s: for slow tests.
"""

import os
import sys
from pathlib import Path

if sys.dont_write_bytecode:
    # Without byte code on disk every process of the tests compiles all libraries anew: 4 CPU s.
    # It is kept outside the tree, for this process and for those that it starts.
    sys.dont_write_bytecode = False
    sys.pycache_prefix = str(Path.home() / ".cache" / "realsim" / "bytecode")
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

import pytest

from shared_sessions import once


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    base = tmp_path_factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


@pytest.fixture(scope="session")
def small_session(run_folder: Path) -> Path:
    from stored_sessions import make_whole

    return once(run_folder, "small_session", make_whole)


@pytest.fixture(scope="session")
def table_views(run_folder: Path) -> Path:
    from registered_sessions import table_session

    return once(run_folder, "table_views", table_session)


@pytest.fixture(scope="session")
def registered_session(run_folder: Path, table_views: Path) -> Path:
    def make(folder: Path) -> None:
        from realsim.app.register.files import write_result
        from realsim.store import SessionStore
        from registered_sessions import models_of, registered_by_hand
        from shared_sessions import copy_of

        store = SessionStore.open(copy_of(table_views, folder))
        write_result(store, registered_by_hand(store), models_of(), {})

    return once(run_folder, "registered_session", make)


@pytest.fixture(scope="session")
def demo_session(run_folder: Path) -> Path:
    def make(folder: Path) -> None:
        from realsim.app.console import Console
        from realsim.app.demo.run import DemoConfig, run_demo

        config = DemoConfig(views=6, objects=2, grasps_per_object=8, width=640, workers=1)
        run_demo(config, folder, Console(quiet=True))

    return once(run_folder, "demo", make) / "session"
