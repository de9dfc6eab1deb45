"""Laws of plan files: what is written comes back, and what was mixed up is named."""

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from given_plans import HOME, a_plan
from realsim.errors import RealsimError
from realsim.robots.arm import UR5, UR5E
from realsim.robots.kinematics import DhChain
from realsim_capture_plans.plan_files import plan_json
from realsim_capture_plans.plan_files.imported import colliding_legs
from realsim_capture_plans.plan_files.plan_json import load_plan, plan_to_json, save_plan
from realsim_capture_plans.planning.ordering import move_seconds
from realsim_capture_plans.planning.record import hash_of
from refusals import refused


def said_of(data: Any, folder: Path) -> str:
    """Return how a plan file of this content is refused."""
    (folder / "p.json").write_text(json.dumps(data))
    return refused(r"p\.json", load_plan, folder / "p.json", error=RealsimError)


def said_when(change: Callable[[dict[str, Any]], object], folder: Path) -> str:
    """Return how a plan is refused that another program changed, with a hash that fits."""
    data = json.loads(json.dumps(plan_to_json(a_plan())))
    change(data)
    return said_of(data | {"sha256": hash_of(data["content"])}, folder)


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
    text = said_when(lambda d: d.update(content=other), tmp_path)
    assert "fit a UR5" in text and "UR5e" in text
    assert "those of a UR5" in said_when(lambda d: d["content"].update(robot="UR5e"), tmp_path)


def test_joints_of_another_arm_are_named(tmp_path: Path) -> None:
    text = said_when(lambda d: d["content"]["joints"][2].append(0.0), tmp_path)
    assert "view 2 has 7 joint angles" in text and "a UR5, has 6 joints" in text


def test_degrees_and_millimetres_are_named(tmp_path: Path) -> None:
    def degrees(data: dict[str, Any]) -> None:
        data["content"]["joints"] = np.degrees(data["content"]["joints"]).tolist()

    text = said_when(degrees, tmp_path)
    assert "degrees" in text and "view" in text

    def small_degrees(data: dict[str, Any]) -> None:
        # poses as the radians give them, joints so near zero that no number is suspicious
        q = np.array(data["content"]["joints"])
        near = replace(a_plan(), joints=q * 0.02, home=HOME * 0.02, vias=())
        data |= plan_to_json(near)
        degrees(data)

    assert "degrees; radians are needed" in said_when(small_degrees, tmp_path)

    def millimetres(data: dict[str, Any]) -> None:
        for T in data["expected"]["Ts_base_ee"]:
            for row in T[:3]:
                row[3] *= 1000.0

    assert "in millimetres; metres" in said_when(millimetres, tmp_path)
    text = said_when(lambda d: d["content"].update(center_world=[370.0, 20.0, 50.0]), tmp_path)
    assert "center_world" in text and "millimetres" in text

    def turned(data: dict[str, Any]) -> None:
        Ts = np.array(data["expected"]["Ts_base_ee"])
        data["expected"]["Ts_base_ee"] = (np.diag([-1.0, -1, 1, 1]) @ Ts).tolist()

    assert "base_link" in said_when(turned, tmp_path)


def test_one_changed_view_is_the_one_that_is_named(tmp_path: Path) -> None:
    def move(data: dict[str, Any]) -> None:
        data["expected"]["Ts_base_ee"][5][0][3] += 0.004

    assert "view 5 differs most, by 4.00 mm" in said_when(move, tmp_path)

    def bend(data: dict[str, Any]) -> None:
        data["segments"][6]["corners"][0][1] += 1e-4

    def hurry(data: dict[str, Any]) -> None:
        data["segments"][6]["speed_rad_s"] = 3.0

    for change in (bend, hurry):
        assert "segment of view 6" in said_when(change, tmp_path)


def test_no_file_ends_in_a_traceback(tmp_path: Path) -> None:
    for text in ("", "[]", '{"schema": "realsim capture plan"}', "[" * 100_000, "\x00"):
        (tmp_path / "p.json").write_text(text)
        refused(r"p\.json", load_plan, tmp_path / "p.json")


def test_every_key_is_needed_and_none_ends_in_a_traceback(tmp_path: Path) -> None:
    whole = plan_to_json(a_plan())
    content = whole["content"]
    for key in content:
        said_of(whole | {"content": {k: v for k, v in content.items() if k != key}}, tmp_path)
        said_of(whole | {"content": content | {key: "text"}}, tmp_path)
    for key in ("expected", "segments", "content", "sha256"):
        said_of({k: v for k, v in whole.items() if k != key}, tmp_path)


def test_a_plan_of_version_1_says_what_to_do(tmp_path: Path) -> None:
    text = said_of(plan_to_json(a_plan()) | {"schema_version": 1}, tmp_path)
    assert "schema version 1" in text and "Make the plan anew" in text


def test_a_shipped_plan_that_is_not_there_is_named(tmp_path: Path) -> None:
    refused("nowhere", plan_json.resolve_plan, "shipped:nowhere")
    refused("no plan at", plan_json.resolve_plan, tmp_path / "p.json")
    save_plan(a_plan(), tmp_path / "p.json")
    assert plan_json.resolve_plan(str(tmp_path / "p.json")).content_hash == a_plan().content_hash


def test_the_shipped_plan_keeps_its_promises() -> None:
    name = "ur5_d405_hemisphere_256"
    if name not in plan_json.shipped_plans():
        pytest.skip(f"{name} is not shipped")
    plan = plan_json.resolve_plan(f"shipped:{name}")
    assert len(plan) == 256 and plan.robot == "UR5" and plan.mount.camera == "D405"
    assert np.all(plan.chain.limits.contains(plan.joints))
    assert colliding_legs(plan) == ()
