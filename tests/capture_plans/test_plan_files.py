"""Laws of plan files: what is written comes back, and what was mixed up is named."""

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from given_plans import HOME, a_plan
from realsim.errors import InputError, RealsimError
from realsim.robots.arm import UR5, UR5E
from realsim.robots.kinematics import DhChain
from realsim_capture_plans.plan_files import plan_json
from realsim_capture_plans.plan_files.imported import colliding_legs
from realsim_capture_plans.plan_files.plan_json import load_plan, plan_to_json, save_plan
from realsim_capture_plans.planning.ordering import move_seconds
from realsim_capture_plans.planning.record import CapturePlan, hash_of
from refusals import refused as refused_by


def rewritten(plan: CapturePlan, change: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """A file as another program writes it: changed, with a hash that fits its content."""
    data = json.loads(json.dumps(plan_to_json(plan)))
    change(data)
    return data | {"sha256": hash_of(data["content"])}


def refused(data: Any, path: Path) -> str:
    path.write_text(json.dumps(data))
    return refused_by(".", load_plan, path, error=RealsimError)


@pytest.mark.parametrize("chain", [UR5E, replace(UR5, delta_d=[0, 11.2, -92.5, 81.3, 0, 0])])
def test_what_is_saved_comes_back_bit_for_bit(chain: DhChain, tmp_path: Path) -> None:
    plan = a_plan(chain)
    save_plan(plan, tmp_path / "plan.json")
    back = load_plan(tmp_path / "plan.json")
    assert back.content_hash == plan.content_hash
    for name in ("home", "joints", "center_world", "Ts_base_ee", "Ts_base_cam"):
        assert np.array_equal(getattr(back, name), getattr(plan, name)), name
    assert back.config == plan.config and back.metrics == plan.metrics
    assert asdict(back.cell) == asdict(plan.cell)
    assert [k for k, _ in back.vias] == [0, 4]
    assert all(np.array_equal(a, b) for (_, a), (_, b) in zip(back.vias, plan.vias, strict=True))
    # Saving again writes the same bytes.
    save_plan(back, tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "plan.json").read_bytes()


def test_the_hash_is_of_what_the_plan_is_made_of(tmp_path: Path) -> None:
    plan = a_plan()
    for other in (
        replace(plan, home=plan.home + 1e-12),
        replace(plan, vias=plan.vias[:1]),
        replace(plan, config=replace(plan.config, speed=1.0)),
        a_plan(UR5E),
        a_plan(seed=1),
    ):
        assert other.content_hash != plan.content_hash
    assert a_plan().content_hash == plan.content_hash


def test_another_program_drives_the_plan_from_the_segments_alone(tmp_path: Path) -> None:
    plan = a_plan()
    save_plan(plan, tmp_path / "plan.json")
    segments = json.loads((tmp_path / "plan.json").read_text())["segments"]
    at = plan.home
    for k, segment in enumerate(segments):
        corners = np.array(segment["corners"])
        assert segment["view"] == k and np.array_equal(corners[0], at)
        assert np.array_equal(corners, plan.move(k))
        assert segment["settle_s"] == 0.4
        leading = np.abs(np.diff(corners, axis=0)).max(-1)
        pace = segment["speed_rad_s"], segment["acceleration_rad_s2"]
        assert segment["seconds"] == pytest.approx(move_seconds(leading, *pace).sum(), abs=1e-6)
        at = corners[-1]
    assert np.array_equal(at, plan.joints[-1])


def test_a_plan_of_another_robot_is_named(tmp_path: Path) -> None:
    other = plan_to_json(a_plan(UR5E))["content"]
    text = refused(rewritten(a_plan(), lambda d: d.update(content=other)), tmp_path / "p.json")
    assert "fit a UR5" in text and "UR5e" in text and "p.json" in text

    renamed = rewritten(a_plan(), lambda d: d["content"].update(robot="UR5e"))
    assert "those of a UR5" in refused(renamed, tmp_path / "p.json")


def test_joints_of_another_arm_are_named(tmp_path: Path) -> None:
    one_more = rewritten(a_plan(), lambda d: d["content"]["joints"][2].append(0.0))
    text = refused(one_more, tmp_path / "p.json")
    assert "view 2 has 7 joint angles" in text and "a UR5, has 6 joints" in text


def test_degrees_and_millimetres_are_named(tmp_path: Path) -> None:
    path = tmp_path / "p.json"

    def degrees(data: dict[str, Any]) -> None:
        data["content"]["joints"] = np.degrees(data["content"]["joints"]).tolist()

    text = refused(rewritten(a_plan(), degrees), path)
    assert "degrees" in text and "view" in text

    def small_degrees(data: dict[str, Any]) -> None:
        q = np.array(data["content"]["joints"])
        data["content"]["joints"] = np.degrees(q).tolist()
        # poses as the radians give them, joints so near zero that no number is suspicious
        near = replace(a_plan(), joints=q * 0.02, home=HOME * 0.02, vias=())
        data["content"] |= plan_to_json(near)["content"]
        data["content"]["joints"] = np.degrees(near.joints).tolist()
        data["expected"] = plan_to_json(near)["expected"]

    assert "degrees; radians are needed" in refused(rewritten(a_plan(), small_degrees), path)

    def millimetres(data: dict[str, Any]) -> None:
        for T in data["expected"]["Ts_base_ee"]:
            for row in T[:3]:
                row[3] *= 1000.0

    assert "in millimetres; metres" in refused(rewritten(a_plan(), millimetres), path)

    far = rewritten(a_plan(), lambda d: d["content"].update(center_world=[370.0, 20.0, 50.0]))
    text = refused(far, path)
    assert "center_world" in text and "millimetres" in text

    def turned(data: dict[str, Any]) -> None:
        Ts = np.array(data["expected"]["Ts_base_ee"])
        data["expected"]["Ts_base_ee"] = (np.diag([-1.0, -1, 1, 1]) @ Ts).tolist()

    assert "base_link" in refused(rewritten(a_plan(), turned), path)


def test_one_changed_view_is_the_one_that_is_named(tmp_path: Path) -> None:
    def move(data: dict[str, Any]) -> None:
        data["expected"]["Ts_base_ee"][5][0][3] += 0.004

    text = refused(rewritten(a_plan(), move), tmp_path / "p.json")
    assert "view 5 differs most, by 4.00 mm" in text

    def bend(data: dict[str, Any]) -> None:
        data["segments"][6]["corners"][0][1] += 1e-4

    assert "segment of view 6" in refused(rewritten(a_plan(), bend), tmp_path / "p.json")

    hurried = rewritten(a_plan(), lambda d: d["segments"][6].update(speed_rad_s=3.0))
    assert "segment of view 6" in refused(hurried, tmp_path / "p.json")


def test_no_file_ends_in_a_traceback(tmp_path: Path) -> None:
    for text in ("", "[]", '{"schema": "realsim capture plan"}', "[" * 100_000, "\x00"):
        (tmp_path / "p.json").write_text(text)
        with pytest.raises(InputError, match=r"p\.json"):
            load_plan(tmp_path / "p.json")


def test_every_key_is_needed_and_none_ends_in_a_traceback(tmp_path: Path) -> None:
    whole = plan_to_json(a_plan())
    for key in whole["content"]:
        for change in ("drop", "text"):
            data = json.loads(json.dumps(whole))
            if change == "drop":
                del data["content"][key]
            else:
                data["content"][key] = change
            assert "p.json" in refused(data, tmp_path / "p.json"), key
    for key in ("expected", "segments", "content", "sha256"):
        data = {k: v for k, v in whole.items() if k != key}
        assert "p.json" in refused(data, tmp_path / "p.json"), key


def test_a_plan_of_version_1_says_what_to_do(tmp_path: Path) -> None:
    text = refused(plan_to_json(a_plan()) | {"schema_version": 1}, tmp_path / "p.json")
    assert "schema version 1" in text and "Make the plan anew" in text


def test_a_shipped_plan_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nowhere"):
        plan_json.resolve_plan("shipped:nowhere")
    with pytest.raises(InputError, match="no plan at"):
        plan_json.resolve_plan(tmp_path / "p.json")
    save_plan(a_plan(), tmp_path / "p.json")
    back = plan_json.resolve_plan(str(tmp_path / "p.json"))
    assert back.content_hash == a_plan().content_hash


def test_the_shipped_plan_keeps_its_promises() -> None:
    name = "ur5_d405_hemisphere_256"
    if name not in plan_json.shipped_plans():
        pytest.skip(f"{name} is not shipped")
    plan = plan_json.resolve_plan(f"shipped:{name}")
    assert len(plan) == 256 and plan.robot == "UR5" and plan.mount.camera == "D405"
    assert np.all(plan.chain.limits.contains(plan.joints))
    assert colliding_legs(plan) == ()
