"""The tables of a study: errors of every variant, and each compared with the baseline."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from caper_jax.reproduce.paired import MOST_SEEDS, Comparison, compare
from caper_jax.reproduce.report import RELATIVE, Report, Table, number, spread
from caper_jax.reproduce.study import Study
from caper_jax.reproduce.study_measure import ANGLES, Measured
from caper_jax.reproduce.study_run import StudyResult
from caper_jax.visualization.plots import Intervals, Scatter

Errors = dict[str, Any]


@dataclass(frozen=True)
class Metric:
    """One column.

    Attributes:
      label: with its unit.
      digits: shown.
      of: errors of a model -> the value; None where it has no meaning.
      drawn: whether the picture has a panel for it.
    """

    label: str
    digits: int
    of: Callable[[Errors], float | None]
    drawn: bool = False


def metrics_of(study: Study) -> tuple[Metric, ...]:
    """The columns of a study, by what it measures."""
    return _ROOT_METRICS if study.measure == "root" else _METRICS


def _root(key: str, statistic: str, factor: float = 1.0) -> Callable[[Errors], float | None]:
    return lambda errors: _scaled(errors["parts"][0][key][statistic], factor)


def _turned(errors: Errors) -> float | None:
    return _scaled(errors["parts"][0].get("flipped"), 100.0)


def _mean_over(group: str, first: int, key: str, statistic: str, factor: float = 1.0):
    """Mean over parts (from the ``first``) or joints; of states, over those of one unit."""

    def of(errors: Errors) -> float | None:
        values = [
            each[key][statistic]
            for each in errors[group][first:]
            if key != "state" or each["state_unit"] == errors[group][first]["state_unit"]
        ]
        known = [value for value in values if value is not None]
        return _scaled(float(np.mean(known)), factor) if known else None

    return of


def _state(errors: Errors) -> float | None:
    """Median error of the states, degrees, or millimeters for prismatic joints."""
    slides = errors["joints"][0]["state_unit"] == "meters"
    return _mean_over("joints", 0, "state", "median", 1000.0 if slides else 1.0)(errors)


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else factor * value


def _angle(name: str) -> Callable[[Errors], float | None]:
    return lambda errors: errors["root"][name]["median"]


_METRICS = (
    Metric("root rotation, median [deg]", 2, _root("rotation_deg", "median"), drawn=True),
    Metric("root rotation, mean [deg]", 2, _root("rotation_deg", "mean"), drawn=True),
    Metric("root over 30 deg [%]", 1, _turned),
    Metric(
        "other parts' rotation, median [deg]", 2, _mean_over("parts", 1, "rotation_deg", "median")
    ),
    Metric("root translation, median [%]", 2, _root("translation_relative", "median", 100.0)),
    Metric("joint axis, median [deg]", 2, _mean_over("joints", 0, "axis_deg", "median")),
    Metric(
        "joint pivot, median [mm]",
        1,
        _mean_over("joints", 0, "pivot_m", "median", 1000.0),
        drawn=True,
    ),
    Metric("joint state, median [deg or mm]", 2, _state, drawn=True),
)
_ROOT_METRICS = (
    Metric("rotation, median [deg]", 2, _root("rotation_deg", "median"), drawn=True),
    Metric("rotation, mean [deg]", 2, _root("rotation_deg", "mean"), drawn=True),
    Metric("translation, median [%]", 2, _root("translation_relative", "median", 100.0)),
    *(
        Metric(f"{name}, median [deg]", 2, _angle(name))
        for name in (*ANGLES, "first axis", "second axis")
    ),
)


def study_report(result: StudyResult, facts: Sequence[str] = ()) -> Report:
    """Tables, facts and pictures of a study.

    Args:
      result: what it found.
      facts: what it was measured on, one sentence each.
    """
    study = result.study
    metrics = metrics_of(study)
    known = list(dict.fromkeys(one.run.category for one in result.measured))
    rows, compared = [], []
    content: dict[str, Any] = {}
    intervals: dict[str, dict[str, Comparison]] = {m.label: {} for m in metrics if m.drawn}
    for category in known:
        of_variant = {
            variant: [
                one
                for one in result.measured
                if (one.run.category, one.run.variant) == (category, variant)
            ]
            for variant in study.variants
        }
        base = of_variant[study.baseline]
        content[category] = {"variants": {}, "against_baseline": {}}
        for variant, models in of_variant.items():
            rows.append([category, variant, str(len(models)), *_means(models, metrics)])
            lines = [{"seed": m.run.seed, "member": m.run.member, **m.errors} for m in models]
            content[category]["variants"][variant] = lines
            if variant == study.baseline:
                continue
            found = {m.label: _compare(models, base, m) for m in metrics}
            content[category]["against_baseline"][variant] = {
                label: asdict(one) for label, one in found.items() if one is not None
            }
            for metric in metrics:
                if metric.drawn and (one := found[metric.label]) is not None:
                    intervals[metric.label][f"{variant}, {category}"] = one
            compared += _comparison_rows(category, variant, found, metrics)
    header = ("category", "variant", "models", *(metric.label for metric in metrics))
    tables = [
        Table("Errors of unseen frames, mean over models ± standard deviation", header, rows, 2),
        Table(
            f"Against {study.baseline!r}, paired by seed: difference, above 0 it is worse",
            ("category", "variant", "error", "difference", "95 % interval", "p", "seeds to see it"),
            compared,
            3,
        ),
    ]
    curves: dict[str, Any] = _pictures(study, intervals)
    if study.measure == "root":
        curves |= _angle_panels(result, known)
    return Report(
        title=study.title,
        tables=tables if len(study.variants) > 1 else tables[:1],
        facts=[*facts, *_facts(result, metrics)],
        result={"categories": content, "diverged": result.diverged},
        curves=curves,
    )


def _means(models: Sequence[Measured], metrics: Sequence[Metric]) -> list[str]:
    texts = []
    for metric in metrics:
        values = [v for m in models if (v := metric.of(m.errors)) is not None]
        deviation = float(np.std(values, ddof=1)) if len(values) > 1 else None
        texts.append(spread(float(np.mean(values)), deviation, metric.digits) if values else "-")
    return texts


def _compare(
    models: Sequence[Measured], base: Sequence[Measured], metric: Metric
) -> Comparison | None:
    """Over the seeds of which both models are there; None where the metric has no meaning."""
    of_seed = {m.run.seed: metric.of(m.errors) for m in base}
    pairs = [
        (mine, theirs)
        for m in models
        if (mine := metric.of(m.errors)) is not None
        and (theirs := of_seed.get(m.run.seed)) is not None
    ]
    return compare(*zip(*pairs, strict=True)) if pairs else None


def _comparison_rows(
    category: str,
    variant: str,
    found: dict[str, Comparison | None],
    metrics: Sequence[Metric],
) -> list[list[str]]:
    rows = []
    for metric in metrics:
        one = found[metric.label]
        if one is None:
            continue
        interval = needed = "-"
        if one.low is not None and one.high is not None:
            interval = f"{one.low:+.{metric.digits}f} to {one.high:+.{metric.digits}f}"
            needed = f"over {MOST_SEEDS}" if one.seeds_needed is None else str(one.seeds_needed)
        rows.append(
            [
                *(category, variant, metric.label),
                f"{one.difference:+.{metric.digits}f}{' *' if one.is_seen else ''}",
                *(interval, number(one.p_value, 3), needed),
            ]
        )
    return rows


def _facts(result: StudyResult, metrics: Sequence[Metric]) -> list[str]:
    study = result.study
    training = result.measured[0].run.training
    seeds = ", ".join(map(str, study.seed_list))
    data = "all see the same frames" if study.shared_data else "each seed sees its own frames"
    facts = [
        f"preset {study.preset}, {training.training.steps:,} steps of "
        f"{training.training.batch_size} generated frames each; seeds {seeds}; {data}",
        "an asterisk: the 95 % interval leaves out 0 (of many rows, one in twenty does by chance)",
        "seeds to see it: pairs with which a paired t-test at 5 % would find the difference in "
        "four of five studies",
    ]
    if any("translation" in metric.label for metric in metrics):
        facts.append(RELATIVE)
    facts += [f"{name} diverged by step {step}" for name, step in result.diverged.items()]
    return facts


def _pictures(study: Study, intervals: dict[str, dict[str, Comparison]]) -> dict[str, Intervals]:
    """Differences and their intervals, a panel per metric."""
    panels = {
        label: {
            name: (one.difference, one.low, one.high)
            for name, one in found.items()
            if one.low is not None and one.high is not None
        }
        for label, found in intervals.items()
    }
    panels = {label: found for label, found in panels.items() if found}
    title = f"{study.title}: difference to {study.baseline!r}, 95 % intervals"
    return {"differences": Intervals(title, panels)} if panels else {}


def _angle_panels(result: StudyResult, known: Sequence[str]) -> dict[str, Scatter]:
    """Yaw, pitch and roll of every frame, by each variant's first model (figure 11)."""
    plots = {}
    for category in known:
        panels = {}
        for one in result.measured:
            first = one.run.category == category and one.run.variant not in panels
            if first and one.angles is not None:
                yaw, pitch, roll = one.angles.T
                panels[one.run.variant] = (yaw, pitch, roll)
        if panels:
            yaw, pitch, roll = (f"{angle} [deg]" for angle in ANGLES)
            title = f"Errors of the root's rotation, {category}"
            plots[category] = Scatter(title, yaw, pitch, roll, panels)
    return plots
