"""Laws of the tour: every view once, never longer than before, never shorter than the bounds."""

from itertools import permutations, product

import numpy as np
import pytest

from realsim_capture_plans.planning.ordering import Clusters, move_seconds, tour, tour_seconds
from realsim_capture_plans.planning.record import PlanConfig
from realsim_capture_plans.planning.tour_search import held_karp_bound, two_nearest_bound

CONFIG = PlanConfig()
PACE = CONFIG.speed, CONFIG.acceleration
HOME = np.zeros(6)


def random_clusters(views: int, candidates: int, seed: int) -> Clusters:
    rng = np.random.default_rng(seed)
    stops = [rng.normal(size=(1 + rng.integers(candidates), 6)) for _ in range(views)]
    return Clusters.of(stops, HOME, CONFIG)


def shortest(clusters: Clusters) -> float:
    """Time of the best tour, by trying all of them."""
    n = len(clusters)
    rows = [range(a, b) for a, b in zip(clusters.first[1:-1], clusters.first[2:], strict=True)]
    best = np.inf
    for order in permutations(range(n)):
        for path in product(*(rows[i] for i in order)):
            best = min(best, tour_seconds(clusters, np.array(path), CONFIG))
    return best


def test_small_tours_are_the_shortest_there_are_and_bounds_hold() -> None:
    clusters = random_clusters(5, 3, 1)
    path = tour(clusters, CONFIG, np.random.default_rng(0), steps=300)
    best = shortest(clusters)
    assert tour_seconds(clusters, path, CONFIG) == pytest.approx(best)
    assert two_nearest_bound(clusters.least_s) <= best + 1e-9
    bound = held_karp_bound(clusters.least_s, best)
    assert two_nearest_bound(clusters.least_s) - 1e-9 <= bound <= best + 1e-9


def test_a_tour_visits_every_view_once_and_more_steps_never_lengthen_it() -> None:
    clusters = random_clusters(40, 8, 0)
    first = tour(clusters, CONFIG, np.random.default_rng(1), steps=0)
    longer = tour(clusters, CONFIG, np.random.default_rng(1), steps=400)
    for path in (first, longer):
        assert sorted(clusters.stop(row)[0] for row in path) == list(range(40))
        assert all(clusters.row(clusters.stop(row)) == row for row in path.tolist())
    again = tour(clusters, CONFIG, np.random.default_rng(1), steps=50, start=longer)
    seconds = [tour_seconds(clusters, p, CONFIG) for p in (first, longer, again)]
    assert seconds[0] > seconds[1] >= seconds[2] - 1e-9
    bound = held_karp_bound(clusters.least_s, seconds[2])
    assert two_nearest_bound(clusters.least_s) <= bound <= seconds[2]


def test_the_tour_of_points_on_a_line_is_the_line() -> None:
    place = np.random.default_rng(0).permutation(12)
    stops = [np.array([[0.1 * p, 0, 0, 0, 0, 0], [9.0, 9, 9, 9, 9, 9]]) for p in place]
    home = np.array([-0.1, 0, 0, 0, 0, 0])
    clusters = Clusters.of(stops, home, CONFIG)
    path = tour(clusters, CONFIG, np.random.default_rng(0), steps=200)
    visited = [clusters.stop(row) for row in path.tolist()]
    assert [place[view] for view, _ in visited] == list(range(12))
    assert all(candidate == 0 for _, candidate in visited)
    # Without the far candidates, in which all views are one, a line is its own bound.
    alone = Clusters.of([q[:1] for q in stops], home, CONFIG)
    seconds = tour_seconds(clusters, path, CONFIG)
    assert held_karp_bound(alone.least_s, seconds) == pytest.approx(seconds, rel=1e-3)


def test_colliding_moves_are_gone_round() -> None:
    clusters = random_clusters(12, 4, 5)
    free = tour(clusters, CONFIG, np.random.default_rng(0), steps=200)
    rows = [0, *free.tolist()]
    bad = {(rows[3], rows[4]), (rows[4], rows[3]), (rows[7], rows[8]), (rows[8], rows[7])}
    path = tour(clusters, CONFIG, np.random.default_rng(0), steps=300, colliding=bad)
    moves = set(zip([0, *path[:-1].tolist()], path.tolist(), strict=True))
    assert not moves & bad
    plain = tour_seconds(clusters, free, CONFIG)
    assert tour_seconds(clusters, free, CONFIG, bad) == pytest.approx(plain + 2 * 5.0)
    assert plain <= tour_seconds(clusters, path, CONFIG) < plain + 5.0


def test_move_times_are_continuous_and_trapezoidal() -> None:
    knee = CONFIG.speed**2 / CONFIG.acceleration
    just_below = float(move_seconds(knee * (1 - 1e-9), *PACE))
    assert move_seconds(knee, *PACE) == pytest.approx(just_below)
    assert move_seconds(2.0, *PACE) == pytest.approx(2.0 / 1.05 + 1.05 / 1.4)
    assert move_seconds(0.0, *PACE) == 0.0
