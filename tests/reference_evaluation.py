"""The figures of merit again, slow and obvious: the paper's equations (its section 4.1) over lists of pixels.

Nothing here is shared with the library; areas and low confidence are those of `reference`, section 8. A scene is a
namespace of maps of one shape: ``disparity``, ``lower``, ``upper``, ``confidence``, ``valid`` and ``truth``; rules are
a namespace of ``minimum``, ``maximum``, ``threshold``, ``kernel``, ``depth`` and ``tolerance``.
"""

from itertools import groupby
from statistics import mean, median

import numpy as np
import reference


def evaluate(scene, rules, remove_bias=False, with_rejected=False):
    """All figures of a scene; medians and means of nothing are None."""
    known = ~np.isnan(scene.truth) & ~np.isnan(scene.lower)
    bias = 0.0
    if remove_bias:
        bias = middle([float(scene.disparity[p]) - float(scene.truth[p]) for p in pixels(known & scene.valid)]) or 0.0
    report = figures(scene, rules, pixels(known & scene.valid), bias)
    report["bias"] = bias if remove_bias else None
    report["median_error"] = middle(
        [float(scene.disparity[p]) - float(scene.truth[p]) - bias for p in pixels(known & scene.valid)]
    )
    report["tolerance"], report["nominal"] = rules.tolerance, rules.nominal
    truths = [float(scene.truth[p]) for p in pixels(known & scene.valid)]
    report["truth_is_whole"] = bool(truths) and all(truth.is_integer() for truth in truths)
    report["with_rejected"] = figures(scene, rules, pixels(known), bias) if with_rejected else None
    return report


def figures(scene, rules, judged, bias):
    """Accuracy, size and overestimation (paper eq. 14 to 16) of the judged pixels."""
    low = reference.low_confidence(scene.confidence, rules.threshold, rules.kernel)
    truth = {p: float(scene.truth[p]) + bias for p in judged}
    error = {p: abs(truth[p] - float(scene.disparity[p])) for p in judged}
    width = {p: float(scene.upper[p]) - float(scene.lower[p]) for p in judged}
    inside = {
        p: float(scene.lower[p]) - rules.tolerance <= truth[p] <= float(scene.upper[p]) + rules.tolerance
        for p in judged
    }

    def score(p):
        """Gneiting and Raftery (2007), eq. 43, of the interval widened by the tolerance but for its width."""
        lower, upper = float(scene.lower[p]) - rules.tolerance, float(scene.upper[p]) + rules.tolerance
        return width[p] + 2 / (1 - rules.nominal) * max(lower - truth[p], truth[p] - upper, 0)

    def intervals(chosen):
        size = middle([width[p] / max(rules.maximum - rules.minimum, 1) for p in chosen])
        accuracy, mean_width = share([inside[p] for p in chosen]), mean(width[p] for p in chosen) if chosen else None
        return {
            "count": len(chosen),
            "accuracy": accuracy,
            "relative_size": size,
            "mean_width": mean_width,
            "median_width": middle([width[p] for p in chosen]),
            "interval_score": None if rules.nominal is None or not chosen else mean(map(score, chosen)),
        }

    worst = area_errors(low, error, rules.depth)
    report = {
        "all": intervals(judged),
        "high": intervals([p for p in judged if not low[p]]),
        "low": intervals([p for p in judged if low[p]]),
        "bad1": share([error[p] > 1 for p in judged]),
        "bad3": share([error[p] > 3 for p in judged]),
        "truth_outside_range": share([not rules.minimum <= truth[p] <= rules.maximum for p in judged]),
    }
    over = [1 - worst[p] / width[p] for p in judged if low[p] and width[p] > 0]
    report["low"]["relative_overestimation"] = middle(over)
    near = [p for p in judged if error[p] <= 1]
    report["locking"] = locking({p: truth[p] for p in near}, {p: scene.disparity[p] for p in near})
    report["deciles"] = deciles(scene.confidence, judged, inside, width)
    return report


def area_errors(low, error, depth):
    """For every low pixel whose area has an error the largest of them."""
    runs = reference.segments(low)
    worst = {}
    for i, run in enumerate(runs):
        area = {p for j in reference.neighbourhood(runs, i, depth) for p in runs[j]}
        errors = [error[p] for p in area if p in error]
        worst |= {p: max(errors) for p in run if errors}
    return worst


def locking(truth, disparity):
    """The mean cosine of the fractions of disparities, less that of truths."""
    if all(value % 1 == 0 for value in truth.values()):
        return None
    means = [mean(np.cos(2 * np.pi * float(value)) for value in values.values()) for values in (disparity, truth)]
    return means[0] - means[1]


def deciles(confidence, judged, inside, width):
    """Pixels in the order of confidence to 0.001, equal ones together, in tenths of their middle ranks."""
    level = {p: round(1000 * float(confidence[p])) for p in judged if not np.isnan(confidence[p])}
    groups = {}
    below = 0
    for value, members in groupby(sorted(level, key=level.get), level.get):
        same = list(members)
        groups.setdefault(int(10 * (below + len(same) / 2) // len(level)), []).append((value, same))
        below += len(same)
    result = []
    for group in groups.values():
        members = [p for _, same in group for p in same]
        result.append(
            {
                "confidence": [group[0][0] / 1000, group[-1][0] / 1000],
                "count": len(members),
                "accuracy": share([inside[p] for p in members]),
                "mean_width": mean(width[p] for p in members),
            }
        )
    return result


def pixels(chosen):
    """The chosen pixels of a map."""
    return [(int(r), int(c)) for r, c in np.argwhere(chosen)]


def share(answers):
    """Share of the answers that are true, None of none."""
    return sum(answers) / len(answers) if answers else None


def middle(values):
    """Median, None of none."""
    return median(values) if values else None
