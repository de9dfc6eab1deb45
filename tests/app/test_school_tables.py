"""The school's tables and page, from sets alone."""

from dataclasses import replace

import numpy as np

from realsim.app.school import tables
from realsim.geometry.parts import part
from tried_grasps import tried_set


def test_rows_add_up_and_levels_only_rise() -> None:
    rng = np.random.default_rng(5)
    sets = [tried_set(rng, 40, obj_id=2, instance=k) for k in range(3)]
    models = {2: part("cube")}
    header, rows = tables.school_table(sets, models)
    assert header == tables.SCHOOL_HEADER
    plain = [replace(s, measures={}) for s in sets]
    assert tables.school_table(plain, models)[0] == tables.SCHOOL_HEADER[
        :9
    ] and not tables.p_hold_line(plain)
    assert tables.p_hold_line(sets).startswith("p_hold of ")
    assert "estimate" not in tables.p_hold_line(sets)  # they are of Franka's hand
    own = [replace(s, parameters={"config": {"hand": {"name": "wide"}}}) for s in sets]
    assert "for wide it is an estimate" in tables.p_hold_line(own)
    for column in range(1, 8):
        assert int(rows[-1][column]) == sum(int(r[column]) for r in rows[:-1])
    assert [r[0] for r in rows] == ["0 cube", "1 cube", "2 cube", "all"]
    levels, share = tables.survivors(sets[0], "least_friction", "frictions")
    assert np.all(np.diff(levels) < 0) and np.all(np.diff(share) <= 0)
    assert [t[0] for t in tables.level_tables(sets, models)] == ["friction", "force [N]"]
    assert sum(tables.reasons(sets).values()) == sum(bool(f) for s in sets for f in s.failures)


def test_shapes_that_make_labels_doubtful_are_named() -> None:
    rng = np.random.default_rng(7)
    sound = {"convex": {"volume_ratio": 1.02}, "watertight": True}
    fat = {"convex": {"volume_ratio": 1.41}, "watertight": True}
    open_mesh = {"convex": {"volume_ratio": 0.8}, "watertight": False}
    sets = [
        replace(tried_set(rng, 3, instance=k), parameters=p)
        for k, p in enumerate((sound, fat, open_mesh, {}))
    ]
    words = list(tables.doubts(sets, {}))
    assert [w[0] for w in words] == ["1", "2", "2"]
    assert "1.41 times" in words[0] and "0.80 of" in words[1] and "not closed" in words[2]


def test_reasons_lose_their_figures_and_keep_their_words() -> None:
    one = tried_set(np.random.default_rng(5), 3)
    told = (
        "lift: the object's weight is 3.4 times what the grasp bears; not simulated",
        "lift: the object's weight is 7.0 times what the grasp bears; not simulated",
        "lift: the object slipped 21.3 mm and turned 4.0 deg",
    )
    assert tables.reasons([replace(one, failures=told)]) == {
        "lift: the object's weight is more than the grasp bears": 2,
        "lift: the object slipped or turned too far": 1,
    }
