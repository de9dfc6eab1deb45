"""`realsim demonstrations`: what is streamed is what is written, and a page shows it."""

import hashlib
import re
from concurrent.futures import Future
from contextlib import nullcontext

import numpy as np
import pytest

from file_trees import bytes_of
from realsim.app.demonstrations import run as demonstrations
from realsim.app.demonstrations.run import DemonstrationRequest, open_source
from realsim_sim_bridge.demonstrations.lerobot_episodes import (
    GOAL,
    LeRobotDemonstrations,
    episode_columns,
)
from school_sessions import registered
from typed_commands import finished, invoked
from typed_commands import refused as refused_by

SMALL = ("--fps", "4", "--width", "64", "--height", "48", "--limit", "3", "--quiet",
         "--episodes-per-file", "2", "--workers", "1")  # fmt: skip


def refused(*args):
    return refused_by("demonstrations", *args)


@pytest.fixture(scope="module")
def written(weak_school, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "demos"
    finished("demonstrations", weak_school, "--out", out, *SMALL)
    return out


def files_of(folder):
    return {k: v for k, v in bytes_of(folder).items() if not k.endswith(".run.json")}


def test_an_export_to_lerobot_names_the_command_that_writes_it(tmp_path):
    said = invoked("export", tmp_path, "--to", "lerobot", "--out", tmp_path / "out").output
    assert "`realsim demonstrations SOURCE --out FOLDER`" in " ".join(said.split())


@pytest.mark.slow
def test_what_is_streamed_is_what_is_written(weak_school, written):
    import av
    import pyarrow.parquet as pq

    request = DemonstrationRequest(fps=4, width=64, height=48, limit=3)
    source = open_source(weak_school, request, demonstrations.Console(quiet=True))
    chosen = demonstrations.chosen_attempts(source, request)
    table = [r for f in sorted(written.glob("data/*/*.parquet"))
             for r in pq.read_table(f).to_pylist()]  # fmt: skip
    features = LeRobotDemonstrations(source, "", chosen).features
    frames = {}
    for camera in ("front", "wrist"):
        frames[camera] = []
        for path in sorted((written / f"videos/observation.images.{camera}").glob("*/*.mp4")):
            with av.open(str(path)) as video:
                frames[camera] += [f.to_ndarray(format="rgb24") for f in video.decode(video=0)]
    at = 0
    for episode, k in enumerate(chosen):
        d = source[k]
        rows = table[at : at + len(d)]
        assert {r["episode_index"] for r in rows} == {episode}
        for key, values in episode_columns(d).items():
            kind = features[key].dtype
            found = np.array([r[key] for r in rows]).astype(kind)
            np.testing.assert_array_equal(found, np.asarray(values).astype(kind), err_msg=key)
        for step in (d.step(0), d.step(len(d) - 1)):
            for camera in ("front", "wrist"):
                error = frames[camera][at + step.index].astype(float) - step.look(camera)
                assert 10 * np.log10(255**2 / np.mean(error**2)) > 28
        at += len(d)
    assert at == len(table) == len(frames["front"]) == len(frames["wrist"])


@pytest.mark.slow
def test_page_checksums_and_card_are_there(written):
    page = (written / "demonstrations.html").read_text()
    assert page.count('alt="steps" src="data:image/jpeg;base64,') == 3
    assert page.count('poster="data:image/jpeg;base64,') == page.count("<video ") == 6
    sources = re.findall(r'src="(videos/[^"#]+)#t=', page)
    assert len(sources) == 6
    assert all((written / s).is_file() for s in sources)
    for line in (written / "SHA256SUMS").read_text().splitlines():
        digest, name = line.split("  ", 1)
        assert hashlib.sha256((written / name).read_bytes()).hexdigest() == digest, name
    card = (written / "README.md").read_text()
    assert "LeRobot v3.0" in card
    assert GOAL in card
    assert not (written / ".export").exists()


class FirstNeverEnds:
    """A pool of two whose first attempt takes longer than all others."""

    def __init__(self, source):
        self.source, self.first = source, Future()

    def capacity(self):
        return 2

    def submit(self, fn, sent, *args):
        if args[-1] == 0:
            return self.first
        ended = Future()
        ended.set_result(fn(self.source, *args))
        return ended


@pytest.mark.slow
@pytest.mark.parametrize(("workers", "dies_at", "each"), [("1", 1, [0, 1, 2]), ("2", 2, [1, 0, 2])])
def test_an_interrupted_export_goes_on_and_gives_the_same_bytes(
    weak_school, written, tmp_path, monkeypatch, workers, dies_at, each
):
    asked, real = [], LeRobotDemonstrations.episode

    def dying(self, k):
        if k == dies_at:
            raise KeyboardInterrupt
        asked.append(k)
        return real(self, k)

    with monkeypatch.context() as patch:
        patch.setattr(LeRobotDemonstrations, "episode", dying)
        pool = nullcontext(FirstNeverEnds(weak_school))
        patch.setattr(demonstrations, "open_pool", lambda where: pool)
        words = ("demonstrations", weak_school, "--out", tmp_path / "demos", *SMALL[:-1], workers)
        assert invoked(*words).exit_code
    other = (*SMALL[:1], "6", *SMALL[2:])
    assert "another request" in refused(weak_school, "--out", tmp_path / "demos", *other)

    def counting(self, k):
        asked.append(k)
        return real(self, k)

    monkeypatch.setattr(LeRobotDemonstrations, "episode", counting)
    for _ in range(2):  # the second time all is there
        finished("demonstrations", weak_school, "--out", tmp_path / "demos", *SMALL)
    assert asked == each
    assert files_of(tmp_path / "demos") == files_of(written)
    assert "finished export" in refused(weak_school, "--out", written)
    video = next((tmp_path / "demos").rglob("*.mp4"))
    video.write_bytes(video.read_bytes()[:-1])
    damaged = refused(weak_school, "--out", tmp_path / "demos", *SMALL)
    assert f"{video.name}: other bytes than were written" in damaged


@pytest.mark.slow
def test_two_processes_write_the_same_bytes(weak_school, written, tmp_path):
    options = (*SMALL[:-1], "2", "--workers", "2")
    finished("demonstrations", weak_school, "--out", tmp_path / "demos", *options)
    other, one = files_of(tmp_path / "demos"), files_of(written)
    data = [n for n in one if n.startswith(("data/", "videos/", "meta/", "realsim/"))]
    assert {n: other[n] for n in data} == {n: one[n] for n in data} != {}


@pytest.mark.slow
def test_requests_that_cannot_be_are_refused(weak_school, tmp_path):
    out = ("--out", tmp_path / "demos")
    assert "INSTANCE:GRASP" in refused(weak_school, *out, "--grasp", "first")
    assert "no grasp 77" in refused(weak_school, *out, "--grasp", "0:77")
    assert "even numbers" in refused(weak_school, *out, "--width", "65")
    assert "--view 3" in refused(weak_school, *out, "--view", "3")
    assert "no hand-eye calibration" in refused(weak_school, *out, "--hand-eye")
    assert "inside" in refused(weak_school, "--out", weak_school / "demos")
    assert "weighs" in refused(weak_school, *out, "--weighed", "cube=0.5", "--limit", "1")


@pytest.mark.slow
def test_a_grasp_that_the_arm_does_not_reach_is_refused_with_its_reason(weak_school, tmp_path):
    quiet = demonstrations.Console(quiet=True)
    none = open_source(weak_school, DemonstrationRequest(), quiet).not_attempted[0]
    grasp = f"{none.instance}:{none.grasp}"
    assert none.why in refused(weak_school, "--out", tmp_path / "d", "--grasp", grasp)


def test_a_session_without_grasps_says_what_to_run(tmp_path):
    folder = registered(tmp_path / "session")
    assert "realsim school" in refused(folder, "--out", tmp_path / "d")
