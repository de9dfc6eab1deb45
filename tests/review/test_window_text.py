"""The words of the review page: units, whose decision it is, and nothing that a browser obeys."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from realsim import ObjectModel, ObjectPose
from realsim.geometry import se3
from realsim.review import journal
from realsim.review.window import window_text
from realsim.review.window.browser import Place
from realsim.review.window.from_browser import KEYS, STEPS
from reviewed_boxes import MODELS, SCENE

TALL = 1
PLACED = SCENE.objects[1]
NASTY = '<img src=x onerror=alert(1)> [a](javascript:alert(1)) `x` | **b** & "q"'


def entry(comment: str = "", reviewer: str = "ada") -> journal.Entry:
    return journal.new_entry("reject", PLACED, reviewer, comment=comment)


def test_what_people_write_is_never_taken_for_mark_up() -> None:
    line = entry(NASTY, f"eve {NASTY}")
    model = ObjectModel(obj_id=7, name=NASTY, mesh=MODELS[7].mesh)
    shown = replace(PLACED, verdict="rejected", reasons=(NASTY,))
    text = window_text.object_text(shown, shown, model, line)
    for found in (text, window_text.history_text([line]), window_text.signed(line)):
        assert "<img" not in found and "[a](" not in found and "**b**" not in found
    assert "<img" not in window_text.message_html(NASTY, "refused")
    # Our own mark-up is there all the same.
    assert "<span style" in text and "**rejected**" in text


def test_a_comment_cannot_fake_the_line_of_another_reviewer() -> None:
    fake = "ok\r\n- 2026-01-01 10:00 UTC **bob** accepted\u2028# bob\x1b[2J\u202eaccepted"
    for made in (fake, fake.replace("\r\n", "\n"), fake.replace("\r\n", "\x85")):
        line = entry(made, f"eve{made[2:40]}")
        assert window_text.history_text([line]).count("\n") == 0
        plain = window_text.object_text(PLACED, PLACED, MODELS[7], entry("x", "eve"))
        said = window_text.object_text(PLACED, PLACED, MODELS[7], line)
        assert said.count("\n") == plain.count("\n")
        shown = (said.replace("\n", ""), window_text.undo_label(line), window_text.signed(line),
                 window_text.message_html(made, "ok"))  # fmt: skip
        for text in shown:
            assert not any(ord(c) < 32 or c in "\x85\u2028\u202e" for c in text)


def test_the_panel_says_what_was_computed_and_who_said_what() -> None:
    text = window_text.object_text(PLACED, PLACED, MODELS[7], None)
    assert "computed: **doubtful**" in text and "- seen by one view" in text
    assert "nobody has judged it yet" in text
    said = window_text.object_text(PLACED, PLACED, MODELS[7], entry("it floats"))
    assert "**rejected** by ada" in said and "> it floats" in said


def test_certainty_is_in_mm_and_deg_and_leaves_out_the_own_axis() -> None:
    C = np.diag([1.0, 4e-6, 4e-6, 1e-6, 1e-6, 9e-6])
    unknown = ObjectPose(obj_id=TALL, instance=0, T_world_obj=np.eye(4))
    placed = replace(unknown, covariance=C, checks={"probability": 0.987})
    round_ = replace(MODELS[TALL], symmetry_axes=(((1.0, 0.0, 0.0), (0.0, 0.0, 0.0)),))
    text = window_text.certainty_text(placed, round_)
    assert "98.7 %" in text and "3 mm along its worst axis" in text
    assert "0.11 deg" in text and "left out" in text
    assert "57" in window_text.certainty_text(placed, MODELS[TALL])  # 1 rad, with its own axis
    assert "not known" in window_text.certainty_text(unknown, round_)


def test_every_check_is_in_one_of_the_two_tables_with_its_unit() -> None:
    checks = {"agree": 0.71, "residual_median_mm": 0.35, "n_pixels": 92452.0, "gain": 0.9}
    placed = ObjectPose(obj_id=7, instance=3, T_world_obj=np.eye(4), checks=checks)
    main = window_text.checks_table(placed, main=True)
    rest = window_text.checks_table(placed, main=False)
    assert "| 71.0 % |" in main and "| 0.35 mm |" in main and "| 92,452 |" in main
    assert "gain" in rest and "agree" not in rest
    assert main.count("\n") + rest.count("\n") == len(checks) + 2
    empty = ObjectPose(obj_id=7, instance=3, T_world_obj=np.eye(4))
    assert window_text.checks_table(empty, main=True) == "nothing was measured"


def test_100_per_cent_means_that_nothing_is_missing() -> None:
    said = [window_text.percent(share) for share in (0.0, 0.5, 0.9994, 0.999999, 1.0)]
    assert said == ["0 %", "50.0 %", "99.94 %", "99.99 %", "100 %"]


def test_undo_names_whose_line_it_takes_back() -> None:
    assert window_text.undo_label(entry()) == "Undo: ada rejected"
    assert window_text.undo_label(None) == "Undo"
    assert len(window_text.undo_label(entry(reviewer="a" * 80))) <= 48


def test_a_line_in_the_history_has_time_name_and_how() -> None:
    T = se3.from_translation([0.5, 0.0, 0.015])
    moved = journal.new_entry("move", PLACED, "bob", pose=T, how="steps+icp")
    first, second = window_text.history_text([entry("it floats"), moved]).split("\n")
    assert "**bob** moved it (steps+icp)" in first and "**ada** rejected: it floats" in second
    assert re.search(r"\d{4}-\d\d-\d\d \d\d:\d\d UTC", first)


def test_the_page_holds_back_every_key_that_the_server_knows() -> None:
    script = Path(window_text.__file__).with_name("page.js").read_text()
    acts, looks = (re.findall(rf"{name} = /\^\[(\w+)\]", script)[0] for name in ("ACTS", "LOOKS"))
    assert sorted(acts.upper()) == sorted(key.key for key in (*KEYS, *STEPS))
    assert set(looks.upper()) == set("HNPCF"), "they judge and move nothing"


# --- The address of a window: what it says, and that nobody's link can do harm.


def test_an_address_is_read_as_it_was_written() -> None:
    place = Place(
        scene="000050 & more", instance=4, eye=(0.1, -0.25, 1.5), look_at=(0.0, 0.0, 0.0625)
    )
    assert Place.of(place.text("a box")) == place


@pytest.mark.parametrize(
    "text",
    ["", "scene", "=&&=", "instance=-1&view=1e3", "instance=\u0663", "eye=1,2&at=0,0,0",
     "eye=nan,0,0&at=0,0,0", "eye=1e9,0,0&at=0,0,0", "eye=1,1,1&at=1,1,1", "a=1&" * 500],
)  # fmt: skip
def test_what_is_no_place_is_left_out(text: str) -> None:
    assert Place.of(text) == Place()
