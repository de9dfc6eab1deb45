"""LeRobot v3.0 data sets: what is written is what was given, wherever it was interrupted."""

import json
import pickle
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import pyarrow.parquet as pq
import pytest

from file_trees import bytes_of
from realsim.errors import MissingLibraryError
from realsim.formats.export_folder import ExportFolder
from realsim.formats.lerobot import episodes as layout
from realsim.formats.lerobot import spool
from realsim.formats.lerobot.episodes import LeRobotCamera, LeRobotEpisode, LeRobotFeature
from realsim.formats.lerobot.writer import write_lerobot
from refusals import refused

LENGTHS = (3, 7, 4, 1, 5)
FPS = 10
SIZE = (32, 48)
EPISODES = "meta/episodes/*/*.parquet"
CAMERAS = {f"observation.images.{n}": LeRobotCamera(size=SIZE) for n in "ab"}
FEATURES = {
    "observation.state": LeRobotFeature(dtype="float32", names=("x", "y")),
    "action": LeRobotFeature(dtype="float32", names=("x", "y")),
    "phase": LeRobotFeature(dtype="int64"),
    "next.done": LeRobotFeature(dtype="bool"),
}


def pictures(k: int, steps: int) -> Iterator[dict[str, np.ndarray]]:
    """Yield smooth pictures whose brightness tells episode, step and camera."""
    ramp = np.linspace(0, 60, SIZE[1])[None, :, None]
    for s in range(steps):
        yield {
            key: np.broadcast_to(20 + 25 * k + 8 * s + 60 * c + ramp * [1, 0.5, 0], (*SIZE, 3))
            .clip(0, 255)
            .astype(np.uint8)
            for c, key in enumerate(CAMERAS)
        }


def numbers(k: int) -> dict[str, np.ndarray]:
    rng, n = np.random.default_rng(k), LENGTHS[k]
    return {
        "observation.state": rng.normal(size=(n, 2)),
        "action": rng.normal(size=(n, 2)),
        "phase": np.arange(n) // 2,
        "next.done": np.arange(n) == n - 1,
    }


@dataclass
class Source:
    """Five short episodes of two tasks."""

    asked: list[int] = field(default_factory=list)
    dies_at: int | None = None
    cameras: dict = field(default_factory=lambda: dict(CAMERAS))
    change: dict = field(default_factory=dict)
    name = "small"
    robot_type = "panda"
    fps = FPS
    features = FEATURES
    tasks = ("grasp the a", "grasp the b")

    def __len__(self) -> int:
        return len(LENGTHS)

    def episode(self, k: int) -> LeRobotEpisode:
        if k == self.dies_at:
            raise KeyboardInterrupt
        self.asked.append(k)
        whole = LeRobotEpisode(
            task=self.tasks[k % 2], columns=numbers(k), frames=pictures(k, LENGTHS[k]),
            notes={"number": k, "notes": []},
        )  # fmt: skip
        return replace(whole, **self.change)


def write(folder, source=None, **how):
    export = ExportFolder.begin(folder, {"what": "test"})
    written = write_lerobot(source or Source(), export, episodes_per_file=2, **how)
    export.finish({})
    return written


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("lerobot") / "set"
    write(path)
    return path


def test_a_note_says_of_which_episodes_it_is(tmp_path):
    source = Source(change={"notes": {"number": 0, "notes": ["it slips"]}})
    assert write(tmp_path / "set", source).notes == ("episode 0, 1, 2, 3, 4: it slips",)


def rows_of(folder, pattern):
    files = sorted(folder.glob(pattern))
    return [row for f in files for row in pq.read_table(f).to_pylist()]


def decoded(path):
    """Return times [s] and pictures of a video, read by PyAV alone."""
    import av

    with av.open(str(path)) as file:
        assert file.streams.video[0].codec_context.name == "h264"
        frames = [(float(f.time), f.to_ndarray(format="rgb24")) for f in file.decode(video=0)]
    return np.array([t for t, _ in frames]), [rgb for _, rgb in frames]


def test_the_steps_are_those_that_were_given(folder):
    rows = rows_of(folder, "data/*/*.parquet")
    assert len(rows) == sum(LENGTHS)
    at = 0
    for k, n in enumerate(LENGTHS):
        steps = np.arange(n)
        expected = numbers(k) | {
            "index": at + steps, "frame_index": steps, "timestamp": steps / FPS,
            "episode_index": np.full(n, k), "task_index": np.full(n, k % 2),
        }  # fmt: skip
        for key, given in expected.items():
            found = np.array([r[key] for r in rows[at : at + n]])
            single = np.float32 if given.dtype == np.float64 else given.dtype
            np.testing.assert_array_equal(found, given.astype(single), err_msg=key)
        at += n


def test_the_episodes_windows_tile_the_tables_and_the_videos(folder):
    episodes = rows_of(folder, EPISODES)
    assert [e["length"] for e in episodes] == list(LENGTHS)
    assert [e["data/file_index"] for e in episodes] == [0, 0, 1, 1, 2]
    edge = 0
    for e in episodes:
        assert (e["dataset_from_index"], e["dataset_to_index"]) == (edge, edge + e["length"])
        edge += e["length"]
    for camera in CAMERAS:
        for number in (0, 1, 2):
            mine = [e for e in episodes if e[f"videos/{camera}/file_index"] == number]
            edge = 0.0
            for e in mine:
                begin, end = (e[f"videos/{camera}/{x}_timestamp"] for x in ("from", "to"))
                assert begin == edge and end - begin == pytest.approx(e["length"] / FPS, abs=1e-12)
                edge = end
            path = layout.VIDEO_PATH.format(video_key=camera, chunk_index=0, file_index=number)
            times, _ = decoded(folder / path)
            np.testing.assert_allclose(times, np.arange(round(edge * FPS)) / FPS, atol=1e-9)


def test_a_frame_at_its_episodes_time_is_its_picture(folder):
    for e in rows_of(folder, EPISODES):
        k = e["episode_index"]
        for camera in CAMERAS:
            place = {n: e[f"videos/{camera}/{n}"] for n in ("chunk_index", "file_index")}
            times, frames = decoded(folder / layout.VIDEO_PATH.format(video_key=camera, **place))
            for s, given in enumerate(pictures(k, LENGTHS[k])):
                at = np.argmin(abs(times - (e[f"videos/{camera}/from_timestamp"] + s / FPS)))
                error = frames[at].astype(float) - given[camera]
                psnr = 10 * np.log10(255**2 / np.mean(error**2))
                assert psnr > 35, (k, s, camera, psnr)


def test_statistics_are_those_of_all_steps_and_pictures(folder):
    stats = json.loads((folder / layout.STATS).read_text())
    for key in ("observation.state", "action"):
        whole = np.concatenate([numbers(k)[key] for k in range(len(LENGTHS))]).astype(np.float32)
        for name in ("min", "max", "mean", "std"):
            of = getattr(np, name)(whole.astype(np.float64), axis=0)
            np.testing.assert_allclose(stats[key][name], of, atol=1e-12)
        assert stats[key]["count"] == [sum(LENGTHS)]
    for camera in CAMERAS:
        seen = np.stack([p[camera] for k, n in enumerate(LENGTHS) for p in pictures(k, n)]) / 255
        for name in ("min", "max", "mean", "std"):
            found, of = np.array(stats[camera][name]), getattr(np, name)(seen, axis=(0, 1, 2))
            assert found.shape == (3, 1, 1)
            np.testing.assert_allclose(found[:, 0, 0], of, atol=1e-9)


def test_info_says_what_the_tables_hold(folder):
    info = json.loads((folder / layout.INFO).read_text())
    assert info["codebase_version"] == "v3.0"
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (5, 20, 2)
    assert info["splits"] == {"train": "0:5"}
    schema = pq.read_schema(folder / info["data_path"].format(chunk_index=0, file_index=0))
    numeric = {k: f for k, f in info["features"].items() if f["dtype"] != "video"}
    assert list(numeric) == schema.names
    for key, feature in numeric.items():
        kind = str(schema.field(key).type).replace("item:", "element:")
        plain = {"float32": "float", "int64": "int64", "bool": "bool"}[feature["dtype"]]
        n = feature["shape"][0]
        assert kind == (plain if n == 1 else f"fixed_size_list<element: {plain}>[{n}]")
        assert feature["names"] is None or len(feature["names"]) == n
    assert {k for k, f in info["features"].items() if f["dtype"] == "video"} == set(CAMERAS)


def test_a_killed_export_goes_on_at_the_next_episode(folder, tmp_path):
    first, second = Source(dies_at=3), Source()
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "set", first)
    written = write(tmp_path / "set", second)
    assert first.asked + second.asked == list(range(len(LENGTHS)))
    assert written.frames == sum(LENGTHS)
    assert written.frames_written == sum(LENGTHS[3:])
    assert bytes_of(tmp_path / "set") == bytes_of(folder)


def test_columns_without_pictures_are_a_data_set(tmp_path):
    written = write(tmp_path / "set", Source(cameras={}))
    assert written.counts["videos"] == 0
    assert json.loads((tmp_path / "set" / layout.INFO).read_text())["video_path"] is None
    assert not (tmp_path / "set/videos").exists()


@pytest.mark.parametrize(
    ("source", "words"),
    [
        (Source(cameras={"a/b": LeRobotCamera(size=SIZE)}), "no '/'"),
        (Source(cameras={"timestamp": LeRobotCamera(size=SIZE)}), "cannot be called"),
        (Source(change={"task": "another"}), "not among its tasks"),
        (Source(change={"columns": {**numbers(0), "action": np.full((3, 2), np.nan)}}), "finite"),
        (Source(change={"frames": iter(())}), "0 pictures for 3 steps"),
        (Source(change={"frames": iter([dict.fromkeys(CAMERAS, np.zeros((8, 8, 3), np.uint8))])}),
         "does not fit"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused(tmp_path, source, words):
    refused(words, write, tmp_path / "set", source)


def test_a_missing_pyav_is_said_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    source = Source()
    refused(r"realsim\[lerobot\]", write, tmp_path / "set", source, error=MissingLibraryError)
    assert source.asked == []


def test_depth_comes_back_within_its_codes_and_says_how_they_are_read(tmp_path):
    key = "observation.images.a_depth"
    ramp = np.linspace(0.15, 2.0, SIZE[0] * SIZE[1], dtype=np.float32).reshape(SIZE)
    ramp[:3] = 0.0  # nothing
    frames = iter([{key: ramp + np.float32(0.01 * s) * (ramp > 0)} for s in range(LENGTHS[0])])
    camera = LeRobotCamera(size=SIZE, is_depth=True, info={"camera.intrinsics": {"fx": 40.0}})
    source = Source(cameras={key: camera}, change={"frames": frames})
    done = spool.encoded(source, 0)
    path = tmp_path / "depth.mp4"
    path.write_bytes(done.videos[key])
    found = [picture for _, picture in spool.read_video(path)]
    assert len(found) == LENGTHS[0]
    for s, depth in enumerate(found):
        given = ramp + np.float32(0.01 * s) * (ramp > 0)
        # Half a step of the logarithm of z + 3.5 m.
        assert np.all(np.abs(depth - given) <= 1.7e-4 * (given + 3.5) + 1e-6)
        assert np.array_equal(depth == 0, given == 0)
    stats = done.said["pictures"][key]
    assert stats["min"] == [[[pytest.approx(ramp[ramp > 0].min())]]]
    feature = layout.info(source, 1, 3)["features"][key]
    assert feature["shape"] == [*SIZE, 1]
    said = {"is_depth_map": True, "depth_unit": "m", "video.codec": "hevc",
            "video.pix_fmt": "gray12le", "video.depth_min": 0.01, "video.depth_max": 10.0,
            "video.shift": 3.5, "video.use_log": True,
            "camera.intrinsics": {"fx": 40.0}}  # fmt: skip
    assert {k: feature["info"][k] for k in said} == said


def test_what_is_known_of_an_episode_is_a_column_of_meta_episodes(tmp_path):
    known = {"success": True, "p_hold": 0.75, "failure": ""}
    write(tmp_path / "set", Source(change={"metadata": known}))
    rows = rows_of(tmp_path / "set", EPISODES)
    assert len(rows) == len(LENGTHS)
    assert all({k: r[k] for k in known} == known for r in rows)


def test_encoding_elsewhere_gives_the_same_bytes(folder, tmp_path):
    """Episodes may come from other processes, in whatever order they end."""
    source = Source()

    def elsewhere(numbers, take):
        for k, episode in [(k, spool.encoded(source, k)) for k in reversed(numbers)]:
            take(k, pickle.loads(pickle.dumps(episode)))

    write(tmp_path / "set", source, encode=elsewhere)
    assert bytes_of(tmp_path / "set") == bytes_of(folder)
