"""The fit of the probability's coefficients and the figures of its test.

Imported by `registration_calibration.py`.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array, Mask
from realsim.registration.judging import verdict
from realsim.registration.judging.verdict import ACCEPT, NAMES, Coefficients, Kind, terms_of

RIDGE = 0.003
"""Weight of the squared coefficients against the mean log-loss: tables are few, and what separates
them perfectly would grow without bound."""
OTHER_VIEWS = 0.2
"""Weight of samples of several views in the set of one view, and the other way round."""
BINS = 10
DISTORTED = (3, 6, 8)
"""Tables whose models are not quite the objects."""


def fitted(samples: Sequence[Any], right_m: float) -> dict[Kind, Coefficients]:
    """Return the three sets of coefficients; none of them negative but the bias."""
    return {kind: _fitted(samples, kind, right_m) for kind in NAMES}


def _usable(samples: Sequence[Any], kind: Kind) -> list[Any]:
    """Return the samples that a set can be fitted to."""
    if kind == "single_view":
        return [s for s in samples if s["checks"]["n_pixels"] > 0]
    return [s for s in samples if s["views"] > 1 and s["checks"]["n_pixels"] > 0]


def _fitted(samples: Sequence[Any], kind: Kind, right_m: float) -> Coefficients:
    """Return one set: the least mean log-loss with a ridge, coefficients 0 or more."""
    from scipy.optimize import minimize

    used = _usable(samples, kind)
    right = np.array([1e-3 * s["error_mm"] <= right_m for s in used])
    single = np.array([s["views"] == 1 for s in used])
    share = np.where(single == (kind == "single_view"), 1.0, OTHER_VIEWS)
    share /= share.sum()
    rows = [terms_of(s["checks"], kind) for s in used]
    usual = {n: float(np.median([r[n] for r, ok in zip(rows, right, strict=True) if ok and n in r]))
             for n in NAMES[kind]}  # fmt: skip
    X = np.array([[r.get(n, usual[n]) for n in NAMES[kind]] for r in rows])
    center, spread = X.mean(0), X.std(0) + 1e-9
    Z = (X - center) / spread
    sign = np.where(right, 1.0, -1.0)

    def loss(w: Array) -> tuple[float, Array]:
        margin = sign * (Z @ w[1:] + w[0])
        value = float(share @ np.logaddexp(0.0, -margin) + RIDGE * w[1:] @ w[1:])
        slope = -share * sign / (1.0 + np.exp(np.clip(margin, -500, 500)))
        return value, np.concatenate([[slope.sum()], Z.T @ slope + 2 * RIDGE * w[1:]])

    bounds = [(None, None)] + [(0.0, None)] * Z.shape[1]
    w = minimize(loss, np.zeros(Z.shape[1] + 1), jac=True, bounds=bounds, method="L-BFGS-B").x
    weights = w[1:] / spread
    return Coefficients(
        bias=float(w[0] - weights @ center),
        weights={n: float(v) for n, v in zip(NAMES[kind], weights, strict=True) if v > 1e-4},
        usual=usual,
    )


def printed(sets: Mapping[Kind, Coefficients]) -> str:
    """Return the sets as the lines of `verdict.py`."""
    lines = ["COEFFICIENTS: dict[Kind, Coefficients] = {"]
    for kind, c in sets.items():
        lines += [f'    "{kind}": Coefficients(', f"        bias={c.bias:.3f},"]
        lines += ["        weights={"]
        lines += [f'            "{n}": {v:.3f},' for n, v in c.weights.items()]
        lines += ["        },", "        usual={"]
        lines += [f'            "{n}": {v:.3f},' for n, v in c.usual.items()
                  if n not in verdict.NEEDED and abs(v) >= 5e-4]  # fmt: skip
        lines += ["        },", "    ),"]
    return "\n".join([*lines, "}"])


def told(sets: Mapping[Kind, Coefficients], samples: Sequence[Any], drop: str) -> Array:
    """Return the probability of every sample, the checks whose name begins with `drop` left out."""
    before = dict(verdict.COEFFICIENTS)
    verdict.COEFFICIENTS.update(sets)
    try:
        return np.array([
            verdict.probability_right({
                n: v for n, v in s["checks"].items() if not (drop and n.startswith(drop))
            })
            for s in samples
        ])  # fmt: skip
    finally:
        verdict.COEFFICIENTS.clear()
        verdict.COEFFICIENTS.update(before)


def figures(name: str, p: Array, right: Mask) -> str:
    """Return the figures of one group of samples as a line."""
    accept, wrong = ACCEPT, ~right
    order = np.argsort(np.argsort(p, kind="stable"))
    n = int(right.sum()) * int(wrong.sum())
    auc = (order[right].sum() - right.sum() * (right.sum() - 1) / 2) / max(n, 1)
    brier = float(np.mean(np.square(p - right)))
    return (
        f"{name:34s} {right.sum():5d} right {wrong.sum():4d} wrong"
        f" | AUC {auc:.4f} Brier {brier:.4f}"
        f" | wrong not accepted {np.mean(p[wrong] < accept):.4f}"
        f" | right not accepted {np.mean(p[right] < accept):.4f}"
        f" | wrong at 5 % false alarms {np.mean(p[wrong] < np.quantile(p[right], 0.05)):.4f}"
    )


def tested(
    sets: Mapping[Kind, Coefficients],
    learnt: Sequence[Any],
    tests: Sequence[Any],
    right_m: float,
    out: Path | None,
) -> None:
    """Print the figures on the tables that were learnt from, on the others, and crosswise."""
    for name, samples in (("learnt", learnt), ("test", tests)):
        for line in _lines(name, sets, samples, right_m):
            print(line)
    every = [*learnt, *tests]
    seeds = sorted({s["seed"] for s in every})
    across: list[tuple[Array, list[Any]]] = []
    for seed in seeds:
        others = [s for s in every if s["seed"] != seed]
        mine = [s for s in every if s["seed"] == seed]
        across.append((told(fitted(others, right_m), mine, ""), mine))
    p = np.concatenate([a for a, _ in across])
    flat = [s for _, part in across for s in part]
    right = np.array([1e-3 * s["error_mm"] <= right_m for s in flat])
    views = np.array([s["views"] for s in flat])
    for n in sorted(set(views.tolist())):
        print(figures(f"each table by the others, {n} views", p[views == n], right[views == n]))
    several = views > 1
    exact = np.array([s["seed"] not in DISTORTED for s in flat])
    for name, mine in (("exact models", several & exact), ("distorted", several & ~exact)):
        if np.any(mine):
            print(figures(f"each by the others, {name}", p[mine], right[mine]))
    for how in sorted({s["how"] for s in flat}):
        mine = several & np.array([s["how"] == how for s in flat]) & (~right | (how == "right"))
        held = p[mine] >= ACCEPT
        middle = np.median(p[mine]) if np.any(mine) else np.nan
        print(f"  {how:8s} {mine.sum():5d}, accepted {held.sum()}, median P {middle:.4f}")
    for k in np.flatnonzero(several & ~right & (p >= ACCEPT)):
        s = flat[k]
        print(f"  accepted though wrong: {s['how']} {s['object']} table {s['seed']} {s['views']} "
              f"views, {s['error_mm']:.1f} mm off, P {p[k]:.3f}")  # fmt: skip
    print(_reliability("several views", p[several], right[several]))
    print(_reliability("one view", p[~several], right[~several]))
    if out is not None:
        _picture(p, right, several, out)


def _lines(
    name: str, sets: Mapping[Kind, Coefficients], samples: Sequence[Any], right_m: float
) -> list[str]:
    """Return a line per set."""
    lines: list[str] = []
    groups = (("views", "", True), ("no held-out", "held_out", True), ("one view", "", False),
              ("images only", "wrong_", True))  # fmt: skip
    for label, drop, several in groups:
        part = [s for s in samples if (s["views"] > 1) == several]
        if not part:
            continue
        right = np.array([1e-3 * s["error_mm"] <= right_m for s in part])
        lines.append(figures(f"{name}, {label}", told(sets, part, drop), right))
    return lines


def _edges() -> Array:
    """Return the borders of the bins: fine at both ends, where nearly all poses are."""
    return np.array([0.0, 0.01, 0.05, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 0.99, 1.0])


def _bins(p: Array, right: Mask) -> list[tuple[float, float, int]]:
    """Return per bin that has samples the mean told, the share right, and how many."""
    which = np.clip(np.digitize(p, _edges()) - 1, 0, BINS - 1)
    return [(float(p[which == k].mean()), float(right[which == k].mean()), int((which == k).sum()))
            for k in range(BINS) if np.any(which == k)]  # fmt: skip


def _reliability(name: str, p: Array, right: Mask) -> str:
    """Return the bins as text, with their mean error weighted by samples."""
    bins = _bins(p, right)
    error = sum(n * abs(told - share) for told, share, n in bins) / max(len(p), 1)
    text = "  ".join(f"{told:.3f}->{share:.3f} ({n})" for told, share, n in bins)
    return f"{name}: expected calibration error {error:.4f}; told->right (poses): {text}"


def _picture(p: Array, right: Mask, several: Mask, out: Path) -> None:
    """Write the reliability diagram and the histogram of probabilities."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    out.mkdir(parents=True, exist_ok=True)
    figure, (left, below) = plt.subplots(1, 2, figsize=(10, 4.4), layout="constrained")
    left.plot([0, 1], [0, 1], color="0.6", linewidth=1, label="calibrated")
    for name, mine, color in (("several views", several, "C0"), ("one view", ~several, "C1")):
        bins = _bins(p[mine], right[mine])
        told, share, n = (np.array(v, dtype=np.float64) for v in zip(*bins, strict=True))
        bar = 1.96 * np.sqrt((share * (1 - share) + 1 / n) / (n + 4))
        left.errorbar(told, share, bar, fmt="o-", color=color, capsize=3, markersize=5, label=name)
    left.set(xlabel="told probability that the pose is right within 3 mm", ylim=(-0.05, 1.05))
    left.set(ylabel="share that is right", title="Reliability (bars: 95 %)")
    left.legend(loc="lower right")
    groups = [p[right & several], p[~right & several]]
    below.hist(groups, np.linspace(0, 1, 21), color=["C2", "C3"], label=["right", "wrong"])
    below.set_yscale("log")
    below.axvline(ACCEPT, color="0.3", linestyle="--", label="accepted from here")
    below.set(xlabel="told probability", ylabel="poses", title="Several views")
    below.legend(loc="upper center")
    figure.savefig(out / "registration_calibration.png", dpi=110)
    plt.close(figure)
