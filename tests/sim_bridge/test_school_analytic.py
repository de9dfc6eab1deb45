"""Analytic grasps in the School: those of the labels are tried, with the labels' friction.

The School's picture sheet: its figures are the sets', and its words do not overlap.
"""

import io
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from PIL import Image

from realsim.formats.graspnet.grasp_labels import write_grasp_labels
from realsim.formats.grasps.scene_grasps import executed, untried_set
from realsim.geometry.parts import part
from realsim.records import ObjectModel
from realsim.records.grasps import MEASURES
from realsim_sim_bridge.grasping.analytic import AnalyticConfig, analytic_labels
from realsim_sim_bridge.school import SchoolConfig
from realsim_sim_bridge.school.school import run_school
from realsim_sim_bridge.school.sheet import left_after, school_sheet, sheet_figure
from realsim_sim_bridge.school.sheet_object import STOPS, stops_of
from realsim_sim_bridge.school.summary import summarise
from realsim_sim_bridge.slip.engines import MujocoSettings
from refusals import refused
from school_sessions import NAMES, scene
from tried_grasps import tried_set
from trimesh_solids import box

LABELS = AnalyticConfig(points=40, view_step=2)
MODELS = {part(n).obj_id: part(n) for n in NAMES}


def config_of(**changed):
    config = SchoolConfig(max_candidates=12, analytic=LABELS)
    return replace(config, slip=replace(config.slip, engine=MujocoSettings()), **changed)


def test_labels_are_tried_and_keep_their_friction():
    sets = run_school(scene(), MODELS, config_of(), workers=1)
    for s in sets:
        friction = s.measures["closure_friction"]
        assert 0 < len(s) <= 12 and executed(s).any()
        assert np.all(np.isin(friction, LABELS.levels))
        assert s.parameters["analytic"]["from"] == "computed"
    assert len({float(f) for s in sets for f in s.measures["closure_friction"]}) > 1


def test_labels_of_a_file_are_taken_instead_and_told_apart(tmp_path):
    files = {}
    for obj_id, model in MODELS.items():
        files[obj_id] = tmp_path / f"{obj_id - 1:03d}_labels.npz"
        labels = analytic_labels(model.mesh, np.random.default_rng(3), LABELS)
        write_grasp_labels(files[obj_id], labels)
    cache = tmp_path / "cache"
    sets = run_school(
        scene(), MODELS, config_of(), workers=1, cache=cache, label_files=files, restart=True
    )
    for s in sets:
        assert s.parameters["analytic"]["from"] == files[s.obj_id].name
        assert executed(s).any()
    refused("labels", run_school, scene(), MODELS, config_of(), workers=1, cache=cache)


def model(obj_id=1, name="box"):
    return ObjectModel(obj_id=obj_id, name=name, mesh=box((0.05, 0.08, 0.1)))


def some_sets(n_sets=3, n=50, seed=0, **how):
    rng = np.random.default_rng(seed)
    return [tried_set(rng, n, obj_id=1, instance=k, **how) for k in range(n_sets)]


def pixels(png):
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


# --- what is counted --------------------------------------------------------------------------


def test_every_grasp_stopped_somewhere_and_fewer_are_left_each_time():
    sets = some_sets(5)
    stops = np.concatenate([stops_of(s) for s in sets])
    assert stops.min() >= 0 and stops.max() < len(STOPS)
    left = left_after(sets)
    assert left[0] == sum(len(s) for s in sets) and np.all(np.diff(left) <= 0)
    assert left[-1] == sum(int(np.sum(s.base_scores == 1)) for s in sets)
    found = summarise(sets)
    assert left[1] == found.with_trajectory
    assert left[2] == found.with_trajectory - found.outcomes["fail_close"]
    assert left[3] == left[2] - found.outcomes["fail_lift"]


# --- the picture ------------------------------------------------------------------------------


def test_the_same_sets_give_the_same_bytes_and_an_object_stands_as_it_is_told_to():
    s = some_sets(1, 6)
    png = school_sheet(s, {1: model()}, title="Tisch 1")
    again = school_sheet(s, {1: model()}, title="Tisch 1", Ts_up_obj={0: np.eye(4)})
    assert png == again and pixels(png).shape[1] == 1600
    turned = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    assert png != school_sheet(s, {1: model()}, title="Tisch 1", Ts_up_obj={0: turned})


def test_the_bars_of_the_label_hold_as_many_grasps_as_their_title_says():
    figure = sheet_figure(some_sets(), {1: model()}, "t", {})
    ax = next(ax for ax in figure.axes if "tried grasps" in ax.get_title("left"))
    assert f"of {sum(bar.get_height() for bar in ax.patches):.0f} tried" in ax.get_title("left")


@pytest.mark.parametrize("measures", [("margin",), tuple(MEASURES)])
def test_no_two_words_overlap_and_all_are_on_the_sheet(measures):
    name = "a name that is far too long for any panel of a sheet, with a number 000123"
    sets = [replace(s, instance=100 + s.instance) for s in some_sets(3, 30, measures=measures)]
    figure = sheet_figure(sets, {1: model(name=name)}, "A title that is also long " * 4, {})
    figure.canvas.draw()
    texts = [t for ax in figure.axes for t in (*ax.texts, ax.title, ax._left_title)]
    for ax in figure.axes:
        if ax.axison:
            texts += [ax.xaxis.label, ax.yaxis.label]
            for axis, (low, high) in ((ax.xaxis, ax.get_xlim()), (ax.yaxis, ax.get_ylim())):
                texts += [t.label1 for t in axis.get_major_ticks() if low <= t.get_loc() <= high]
    shown = [t for t in (*texts, *figure.texts) if t.get_text().strip() and t.get_visible()]
    boxes = [(t.get_text(), t.get_window_extent()) for t in shown]
    width, height = figure.get_size_inches() * figure.dpi
    assert len(boxes) > 20
    for text, frame in boxes:
        assert frame.x0 >= 0 and frame.x1 <= width
        assert frame.y0 >= 0 and frame.y1 <= height, text
    for (a, frame), (b, other) in combinations(boxes, 2):
        across = min(frame.x1, other.x1) - max(frame.x0, other.x0)
        down = min(frame.y1, other.y1) - max(frame.y0, other.y0)
        assert across <= 0.5 or down <= 0.5, (a, b)


def test_the_hands_are_green_where_all_hold_and_red_where_none_does():
    def counted(score):
        """Return the green and the red pixels as if all grasps had been tried and had the score."""
        alike, slip = np.full(20, score), np.full((20, 4), 0.001)
        s = replace(
            some_sets(1, 20)[0], scores=alike, base_scores=alike, slip_m=slip, slip_rad=slip,
            reachable=np.ones(20, bool), measures={},
        )  # fmt: skip
        rgb = pixels(school_sheet([s], {1: model()}))[390:600]  # the object alone
        saturated = np.ptp(rgb, axis=-1) > 90
        red, green = rgb[saturated][:, :2].T
        return int(np.sum(green > red)), int(np.sum(red > green))

    green, red = counted(1.0)
    assert green > 500 and red == 0
    green, red = counted(0.0)
    assert red > 500 and green == 0


def test_a_set_that_is_empty_or_untried_has_its_panel_too():
    (empty,), (some,) = some_sets(1, 0, measures=()), some_sets(1, 5)
    untried = untried_set(some.Ts_obj_grasp, obj_id=2, instance=1)
    models = {1: model(), 2: model(2, "ünknown $x_1$")}
    figure = sheet_figure([empty, untried], models, "t", {})
    said = [t.get_text() for t in figure.texts]
    assert "no candidate" in said and "n = 5, not tried" in said
    assert "1  ünknown $x_1$" in said  # names are not taken for formulas
    assert len(pixels(school_sheet([], {}))) > 300


def test_an_object_without_a_model_and_too_many_are_named():
    refused("object 1 has grasps but no model", school_sheet, some_sets(1), {5: model(5)})
    refused("61 objects", school_sheet, some_sets(61, 1), {1: model()})
