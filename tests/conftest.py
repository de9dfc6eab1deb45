"""Sessions that all tests of a run share: each is made once, by the process that asks first.

Tests that only read use the folder as it is. A test that writes takes a copy:

    from shared_sessions import copy_of
    session = copy_of(registered_session, tmp_path / "session")

- `run_folder`: one folder for all processes of a run, for further ones (`shared_sessions.once`).
- `small_session`: six views of 40x30, a plan, camera poses, board views inside (stored_sessions).
- `table_views`: rendered depth of a mug and a wedge, eight views of 320x240, models, nothing
  registered (registered_sessions.table_session).
- `registered_session`: the same with a registration that is the truth.
- `few_views`, `registered_few`: the same two with four views.
- `weak_school`: two things whose grasps a weak hand tried; some hold, some slip, some are lost.
- `demo_session`: a whole `realsim demo` of six views, two objects, eight grasps each: captured,
  calibrated, registered, schooled, annotated, reported. It costs about 50 CPU s: for slow tests.
- `rs`: the module pyrealsense2; where it cannot be loaded the test is skipped.
"""

import os
import sys
from functools import partial
from pathlib import Path
from typing import Any

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
def rs() -> Any:
    from realsim.errors import MissingLibraryError
    from realsim.interop import import_pyrealsense2

    try:
        return import_pyrealsense2()
    except MissingLibraryError as error:
        pytest.skip(str(error))


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
    from registered_sessions import registered_copy

    return once(run_folder, "registered_session", partial(registered_copy, table_views))


@pytest.fixture(scope="session")
def few_views(run_folder: Path) -> Path:
    from registered_sessions import table_session

    return once(run_folder, "few_views", partial(table_session, views=4))


@pytest.fixture(scope="session")
def registered_few(run_folder: Path, few_views: Path) -> Path:
    from registered_sessions import registered_copy

    return once(run_folder, "registered_few", partial(registered_copy, few_views))


@pytest.fixture(scope="session")
def weak_school(run_folder: Path) -> Path:
    from school_sessions import tried_weakly

    return once(run_folder, "weak_school", tried_weakly)


@pytest.fixture(scope="session")
def demo_session(run_folder: Path) -> Path:
    def make(folder: Path) -> None:
        from realsim.app.console import Console
        from realsim.app.demo.run import DemoConfig, run_demo

        config = DemoConfig(views=6, objects=2, grasps_per_object=8, width=640, workers=1)
        run_demo(config, folder, Console(quiet=True))

    return once(run_folder, "demo", make) / "session"
