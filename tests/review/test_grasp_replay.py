"""The replay of a grasp: its record, the approach made from the grasp, the player, the words."""

from dataclasses import replace

import numpy as np
import pytest
import viser

from realsim import Mesh
from realsim.arrays import Array
from realsim.geometry import se3
from realsim.records import STAGES
from realsim.records.grasps import PHASES
from realsim.review.replaying import grasp_words as words
from realsim.review.replaying.grasp_replay import GraspMotion, Motions, ReplayPlayer, hand_approach
from realsim.robots.hand import find_hand
from refusals import refused
from reviewed_boxes import grasp_set
from tried_grasps import tried_set
from waiting import comes_about

WIDTH_M = 0.03
TRIANGLE = Mesh(vertices=np.eye(3), faces=np.array([[0, 1, 2]], dtype=np.int32))


T_WORLD_OBJ, T_OBJ_GRASP, T_MOVE = se3.random_transform(np.random.default_rng(3), 3)


def approach(T_world_obj: Array = T_WORLD_OBJ, width_m: float = WIDTH_M) -> GraspMotion:
    return hand_approach(4, 2, T_world_obj, T_OBJ_GRASP, width_m, find_hand())


def carried(seconds: float = 0.4, rate_hz: float = 50.0) -> GraspMotion:
    """A motion whose object is lifted in its second half."""
    n = round(seconds * rate_hz)
    lift = np.maximum(np.arange(n) - n // 2, 0) * 0.01
    Ts = np.tile(np.eye(4), (n, 1, 1))
    Ts[:, 2, 3] = lift
    return GraspMotion(
        instance=1, row=0, time_s=np.arange(n) / rate_hz, Ts_world_hand=Ts,
        opening_m=np.full(n, 0.02), phase=np.where(lift > 0, 3, 2), Ts_world_obj=Ts,
        obj_mesh=TRIANGLE, notes=("a note",),
    )  # fmt: skip


# --- the record and the approach ----------------------------------------------------------------


def test_the_approach_ends_in_the_grasp_with_closed_fingers() -> None:
    motion = approach()
    closing = motion.Ts_world_hand[motion.phase == PHASES.index("close")]
    grasp = np.broadcast_to(T_WORLD_OBJ @ T_OBJ_GRASP, closing.shape)
    np.testing.assert_allclose(closing, grasp, atol=1e-12)
    assert motion.opening_m[-1] == pytest.approx(WIDTH_M, abs=1e-12)
    assert motion.opening_m[0] == find_hand().max_opening_m


@pytest.mark.parametrize("width_m", [0.0, 0.11])
def test_time_increases_and_fingers_only_close(width_m: float) -> None:
    motion = approach(width_m=width_m)
    assert np.all(np.diff(motion.time_s) > 0)
    assert np.all(np.diff(motion.opening_m) <= 1e-12) and motion.opening_m.min() >= width_m


def test_the_approach_moves_with_the_world() -> None:
    a, b = approach(), approach(T_MOVE @ T_WORLD_OBJ)
    np.testing.assert_allclose(b.Ts_world_hand, T_MOVE @ a.Ts_world_hand, atol=1e-12)
    np.testing.assert_allclose(b.Ts_world_obj, T_MOVE @ a.Ts_world_obj, atol=1e-12)
    np.testing.assert_array_equal(a.time_s, b.time_s)


def test_motions_that_are_none_are_refused() -> None:
    good = carried()
    for broken in (
        {"time_s": np.zeros(len(good))}, {"opening_m": np.zeros(3)},
        {"phase": np.full(len(good), 17)}, {"Ts_world_obj": good.Ts_world_obj[:2]},
        {"link_meshes": (TRIANGLE,), "Ts_world_link": np.zeros((len(good), 2, 4, 4))},
    ):  # fmt: skip
        refused(".", replace, good, **broken)
    refused("no sample", replace, good, time_s=np.zeros(0))


# --- the player ---------------------------------------------------------------------------------


class Given:
    """Motions that are handed over; those of row 9 are not known."""

    def __init__(self, motion: GraspMotion) -> None:
        self.given = motion

    def motion(self, instance: int, row: int) -> GraspMotion | None:
        return None if row == 9 else replace(self.given, instance=instance, row=row)


def player_of(server: viser.ViserServer, motions: Motions, **kwargs: object) -> ReplayPlayer:
    return ReplayPlayer(server.scene, server.gui, motions, atomic=server.atomic, **kwargs)  # pyright: ignore[reportArgumentType]


def test_a_replay_runs_to_its_end_and_carries_the_object(server: viser.ViserServer) -> None:
    told: list[tuple[int, bool]] = []
    motion = carried()
    player = player_of(server, Given(motion), on_carried=lambda i, c: told.append((i, c)))
    shown = player.show(1, 0)
    assert shown is not None and shown.row == 0 and player.playing
    assert comes_about(lambda: not player.playing)
    assert player.time_s == pytest.approx(motion.time_s[-1])
    assert told == [(1, True)]
    node = player._nodes._object  # pyright: ignore[reportPrivateUsage]
    assert node.visible
    np.testing.assert_allclose(node.position, motion.Ts_world_obj[-1, :3, 3], atol=1e-6)
    player.clear()
    assert told[-1] == (1, False) and player.motion is None


def test_seeking_puts_the_hand_where_the_motion_says(server: viser.ViserServer) -> None:
    motion = approach()
    player = player_of(server, Given(motion))
    player.show(4, 2, play=False)
    assert not player.playing
    for k in (0, len(motion) // 2, len(motion) - 1):
        player.seek(float(motion.time_s[k]))
        palm, left, right = player._nodes._boxes  # pyright: ignore[reportPrivateUsage]
        T = motion.Ts_world_hand[k]
        np.testing.assert_allclose(palm.position, T[:3, 3], atol=1e-6)
        apart = np.linalg.norm(np.array(left.position) - np.array(right.position))
        assert apart == pytest.approx(motion.opening_m[k], abs=1e-6)
        middle = (np.array(left.position) + np.array(right.position)) / 2
        np.testing.assert_allclose(middle, T[:3, 3], atol=1e-6)
    player.clear()


def test_another_grasp_ends_the_thread_of_the_one_before(server: viser.ViserServer) -> None:
    import threading

    def threads() -> int:
        return sum(t.name == "grasp-replay" for t in threading.enumerate())

    player = player_of(server, Given(carried(60.0, 5.0)))
    for row in range(5):
        player.show(0, row)
    assert comes_about(lambda: threads() == 1)
    assert player.motion is not None and player.motion.row == 4
    player.pause()
    assert comes_about(lambda: threads() == 0)
    assert player.show(0, 9) is None and player.motion is None, "nothing is known of row 9"


def test_a_browser_that_is_gone_ends_the_replay(server: viser.ViserServer) -> None:
    there = [True]
    player = player_of(server, Given(carried(60.0, 5.0)), connected=lambda: there[0])
    player.show(0, 0)
    assert player.playing
    there[0] = False
    assert comes_about(lambda: not player.playing)
    player.clear()


def test_the_arm_can_be_hidden_and_the_hand_stays(server: viser.ViserServer) -> None:
    given = carried()
    Ts = np.stack([given.Ts_world_hand] * 3, axis=1)
    given = replace(given, link_meshes=(TRIANGLE,) * 3, Ts_world_link=Ts, arm_links=2)
    player = player_of(server, Given(given))
    player.show(0, 0, play=False)
    nodes = player._nodes  # pyright: ignore[reportPrivateUsage]

    def visible() -> list[bool]:
        return [n.visible for n in nodes._links]  # pyright: ignore[reportPrivateUsage]

    assert visible() == [False, False, True], "an arm hides what it grasps"
    nodes.show_arm(True)
    assert visible() == [True] * 3
    nodes.show_arm(False)
    player.seek(0.2)
    assert visible() == [False, False, True]
    np.testing.assert_allclose(nodes._links[2].position, Ts[given.at(0.2), 2, :3, 3], atol=1e-6)  # pyright: ignore[reportPrivateUsage]
    player.clear()


# --- words --------------------------------------------------------------------------------------


def test_slips_are_read_as_numbers_lost_or_not_tried() -> None:
    said = [words.slip_words(v) for v in (np.nan, np.inf, 1.234)]
    assert said == [words.NOT_TRIED, words.LOST, "1.23"]


def test_the_words_of_every_grasp_say_stage_by_stage_what_is_stored() -> None:
    grasps = tried_set(np.random.default_rng(0))
    for row in range(len(grasps)):
        table = words.slip_table(grasps, row)
        assert [line.split("|")[1].strip() for line in table[2:]] == list(STAGES)
        for line, slip in zip(table[2:], grasps.slip_m[row], strict=True):
            cell = line.split("|")[2].strip()
            if np.isfinite(slip):
                assert float(cell) == pytest.approx(1e3 * slip, abs=0.006)
            else:
                assert cell == (words.LOST if np.isinf(slip) else words.NOT_TRIED)
        text = words.grasp_words(grasps, row, "mug")
        assert f"Grasp {row}" in text and "mug" in text
        assert words.escaped(grasps.failures[row]) in text and words.why_words(grasps, row) in text
        assert ("does not reach" in text) is not bool(grasps.reachable[row])
        assert "nan" not in text and "inf" not in text.replace("instance", "")


def test_one_sentence_says_why_a_grasp_failed() -> None:
    grasps = grasp_set(1, 0, 7)
    failures = (
        "lift: the object slipped 7.5 mm", "collides with the table", "too few *pads*", "",
        "close: the fingers did not both touch the object", "", "",
    )  # fmt: skip
    nan = np.full(7, np.nan)
    measures = {
        "p_hold": np.array([*nan[:5], 0.4, 0.9]),
        "share_missed": np.array([*nan[:5], 0.1, 0.0]),
        "share_overloaded": np.array([*nan[:5], 0.5, 0.1]),
    }
    grasps = replace(
        grasps, failures=failures, measures=measures, base_scores=np.ones(7),
        scores=np.array([0.2, 0, np.nan, 1, 0, 1, 1]), reachable=np.arange(7) != 1,
    )  # fmt: skip
    assert [words.why_words(grasps, row) for row in range(7)] == [
        "It failed during the lift: the object slipped 7.5 mm.",
        "The arm does not reach it: collides with the table.",
        "It was not tried: too few \\*pads\\*.",
        "It held in all four stages.",
        "It failed while the fingers closed: the fingers did not both touch the object.",
        "It held as planned, but fails in 60 % of the draws, most often because the load is too "
        "large.",
        "It held in all four stages.",
    ]
    unknown = replace(grasps, failures=("",) * 7, base_scores=np.zeros(7))
    assert words.why_words(unknown, 4) == "It failed: no reason is stored."
    refused(".", words.grasp_words, grasps, 7, error=IndexError)


def test_names_of_people_are_neither_html_nor_markdown() -> None:
    assert words.escaped("a\r\nb\x00\u2029c") == "a b c"
    assert words.escaped("<b>*a*|`x`</b>") == "&lt;b&gt;\\*a\\*\\|\\`x\\`&lt;/b&gt;"
