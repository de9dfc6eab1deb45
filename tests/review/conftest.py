"""A session that nothing writes to, what is shown of it, and a server of viser's."""

from collections.abc import Iterator

import pytest
import viser

from realsim.review.content.content import SceneContent
from realsim.store import SessionStore
from reviewed_boxes import CONFIG, boxes_session


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> SessionStore:
    """Return a session that tests only read."""
    return boxes_session(tmp_path_factory.mktemp("store") / "boxes")


@pytest.fixture(scope="module")
def shown(store: SessionStore) -> SceneContent:
    return SceneContent.load(store, CONFIG)


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    made = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield made
    made.stop()
