"""Runs the methods on the problems of the benchmark, scores their motions, and writes the tables.

  python3 benchmark/run.py                     all problems, those with few pixels first
  python3 benchmark/run.py coupon wafer-100    these problems
  --jobs N       problems at the same time (default: the processors)
  --out DIR      runs and scores (default: out/benchmark)
  --tables DIR   folder of the tables (default: that of --out)
  --scored       no runs: the tables of the problems that have scores
  --finer        these problems again on a map with half the pitch: do the methods keep their order?
  --errors       these problems again with the errors of the process, by their recommended plans
  --defaults     other values of the settings, one at a time, on these maps: how far is each default from the best?

A problem that has its scores is not run again. A measured problem whose part is missing is left out, with the reason.
Every map has the plans of `planish run raster` and all schedulers, and every line those of `planish run line`. A map of
up to 12000 pixels also has all dwell solvers, executed by PVT, B-spline feeds, and the plans of two other paths. The
pitch is a quarter of the width of the tool; the other settings are those of the pipelines.
"""

import argparse
import ast
import csv
import json
import math
import os
import shutil
import struct
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from itertools import combinations
from pathlib import Path
from statistics import median

ROOT = Path(__file__).resolve().parent.parent
PROGRAMS = ROOT / "target/release"
FOLDER = ROOT / "benchmark/problems"
# Pixels of the largest map on which every method runs.
SMALL = 12000
# Schedulers beside those that every pipeline runs.
SCHEDULERS = {
    "average-velocity": ["average-velocity"],
    "stop-at-corners": ["stop-at-corners"],
    "pvt+smooth": ["pvt", "--mode", "smooth"],
    "pvt-as-published": ["pvt-as-published"],
    "trig-spline": ["trig-spline"],
    "trig-spline+local": ["trig-spline", "--repair", "local"],
}
OTHER_PATHS = ["maze", "random-adaptive"]
# Other values of the settings of a joint plan, one at a time: a setting, and its value in the unit after it. A width is
# that of the tool at half its peak.
OTHER_VALUES = [
    ("pitch_mm", 0.15, "widths"),
    ("pitch_mm", 0.35, "widths"),
    ("pitch_mm", 0.5, "widths"),
    ("node_spacing_mm", 0.4, "widths"),
    ("node_spacing_mm", 0.9, "widths"),
    ("overscan_mm", 0, "widths"),
    ("overscan_mm", 0.5, "widths"),
    ("min_dwell_s_per_mm", 0.05, ""),
    ("min_dwell_s_per_mm", 0.2, ""),
    ("time_elasticity", 0.25, ""),
    ("time_elasticity", 1, ""),
    ("time_elasticity", 2, ""),
    ("scan", "y", ""),
    ("path", "maze", ""),
    ("path", "spiral", ""),
    ("path", "random-adaptive", ""),
]
# Name of the choice of a machine whose limits are 100 times as large.
FAST = "limits times 100"
COLUMNS = [
    "time_s",
    "residual_rms_nm",
    "residual_rms_detilted_nm",
    "residual_pv_nm",
    "slope_rms_nrad",
    "bound_rms_nm",
    "reached_rms_nm",
    "excess",
    "bound_time_s",
    "excess_time",
]


class Failed(Exception):
    """A program has ended without a result; the message is the reason why its problem is left out."""


def start(program, *words, log):
    """Runs a program and returns its exit code and what it printed; messages go to the log."""
    with log.open("a") as messages:
        command = [PROGRAMS / program, *map(str, words)]
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=messages, text=True)
    return done.returncode, done.stdout


def check_code(code, command, log):
    """Refuses the exit code of a program without a result: an error, or a signal. A negative verdict is a result."""
    if code not in (0, 1):
        raise Failed(f"`{command}` ended with code {code}; see {log}")


def array(file):
    """Returns the shape and the numbers of an array of doubles in NumPy's format."""
    content = file.read_bytes()
    start = 10 + struct.unpack("<H", content[8:10])[0]
    header = content[10:start].decode()
    shape = ast.literal_eval(header)["shape"]
    return shape, struct.unpack(f"<{(len(content) - start) // 8}d", content[start:])


def width_mm(tif):
    """Returns the width of the tool at half its peak, mm: that of a disk of the same area."""
    _, rate = array(tif / "rate_nm_per_s.npy")
    steps = [x[1] - x[0] for _, x in (array(tif / f"{axis}_mm.npy") for axis in "xy")]
    area = sum(value >= 0.5 * max(rate) for value in rate) * steps[0] * steps[1]
    return math.sqrt(4 * area / math.pi)


def definition(name):
    return json.loads((FOLDER / f"{name}.json").read_text())


def measured_folder(problem):
    """Returns the folder of a measured part; None if the part comes from a recipe."""
    return (FOLDER / problem["measured"]["folder"]).resolve() if "measured" in problem else None


def is_line(name):
    return name.startswith("dabam-")


def pixels(name):
    """Returns the number of pixels of the map; none for a measured part that is missing."""
    problem = definition(name)
    folder = measured_folder(problem)
    if folder is None:
        columns, rows = json.loads((FOLDER / problem["recipe"]).read_text())["pixels"]
        return columns * rows
    file = folder / "surface/height_nm.npy"
    return math.prod(array(file)[0]) if file.exists() else 0


def part(name, problem, out, log):
    """Returns the settings of a run: map, tool, and pitch or profile; None if the part is missing."""
    folder = measured_folder(problem)
    if folder is None:
        folder = out / "part"
        code, _ = start("planish-fixture", FOLDER / problem["recipe"], "--out", folder, "--force", log=log)
        check_code(code, "planish fixture", log)
    elif not (folder / "surface").exists():
        return None
    settings = {"surface": folder / "surface", "tif": folder / "tif"}
    if not is_line(name):
        settings["pitch_mm"] = round(0.25 * width_mm(folder / "tif"), 2)
    return settings


def pipeline_of(name, settings):
    """Returns the pipeline of a problem, and its settings."""
    if not is_line(name):
        return "raster", settings
    line = json.loads((settings["surface"].parent / "line.json").read_text())
    return "line", line | {"machine": settings["machine"], "plan_joint": "yes"}


def plan(name, settings, out, log):
    """Runs all methods. Returns the motions by the names of their methods, and the recommended method."""
    path, settings = pipeline_of(name, settings)
    plans = out / path
    run_pipeline(path, settings | {"frames": 0}, plans, log)
    machine = next(plans.glob("machine/*.json"), settings["machine"])
    for scheduler, flags in SCHEDULERS.items():
        files = ["--tool-path", plans / "tool_path", "--dwell", plans / "dwell", "--machine", machine]
        to = ["--out", plans / f"methods/{scheduler}/trajectory", "--force"]
        start("planish-schedule", *flags, *files, *to, log=log)
    if path == "raster" and pixels(name) <= SMALL:
        tool = ["--surface", plans / "surface", "--tif", settings["tif"], "--tool-path", plans / "tool_path"]
        to = ["--machine", machine, "--out", plans / "methods/bspline", "--force"]
        start("planish-bspline-feed", *tool, *to, log=log)
        run_pipeline("compare-dwell", settings | {"path": plans / "tool_path"}, out / "solvers", log)
        for other in OTHER_PATHS:
            run_pipeline(other, settings | {"frames": 0, "plan_joint": "no"}, out / other, log)
    motions = {}
    for motion in sorted(out.glob("*/methods/*/trajectory")):
        motions[f"{motion.parts[-4]} {motion.parts[-2]}"] = motion
    for motion in sorted(out.glob("solvers/solvers/*/executed/trajectory")):
        motions[f"{path} pvt of {motion.parts[-3]}"] = motion
    summary = plans / "report/summary.json"
    answer = json.loads(summary.read_text())["answer"] if summary.exists() else {}
    return motions, f"{path} {answer.get('method')}"


def run_pipeline(pipeline, settings, out, log):
    words = [f"{key}={value}" for key, value in settings.items()]
    code, _ = start("planish-run", "run", pipeline, *words, f"out={out}", log=log)
    check_code(code, f"planish run {pipeline}", log)


def remove_plans(out):
    """Removes the plans that a run left which did not come to its end: their motions would be scored, too."""
    for folder in filter(Path.is_dir, list(out.iterdir())):
        shutil.rmtree(folder)


def planned(name, out, problem, log):
    """Runs all methods unless they have run: their motions, the recommended method and the seconds it took.

    Returns None if the part is missing. Raises Failed if a pipeline has ended without a result.
    """
    file = out / "planned.json"
    if file.exists():
        return json.loads(file.read_text())
    remove_plans(out)
    settings = part(name, problem, out, log)
    if settings is None:
        return None
    settings["machine"] = FOLDER / problem["machine"]
    began = time.monotonic()
    motions, recommended = plan(name, settings, out, log)
    plans = {"recommended": recommended, "plan_s": time.monotonic() - began}
    plans["motions"] = {method: str(motion) for method, motion in motions.items()}
    file.write_text(json.dumps(plans, indent=2) + "\n")
    return plans


def scores_of(out, name):
    """Returns the scores of a problem; None if it has none, or those of an older format."""
    file = out / "runs" / name / "scores.json"
    scored = json.loads(file.read_text()) if file.exists() else None
    return scored if isinstance(scored, dict) else None


def score(problem_file, motions, log):
    """Returns the scores of the motions, in their order."""
    code, text = start("planish-benchmark", "score", "--no-errors", problem_file, *motions.values(), log=log)
    check_code(code, "planish benchmark score", log)
    rows = json.loads(text)
    return rows if len(motions) > 1 else [rows]


def run(name, out, problem_file=None):
    """Runs and scores a problem. Returns its scores, and a reason if it has none."""
    scored = scores_of(out, name)
    if scored:
        return scored, None
    out = out / "runs" / name
    out.mkdir(parents=True, exist_ok=True)
    log = out / "log.txt"
    problem_file = problem_file or FOLDER / f"{name}.json"
    try:
        plans = planned(name, out, json.loads(problem_file.read_text()), log)
    except Failed as failure:
        return None, str(failure)
    if plans is None:
        return None, "its part is missing; benchmark/measured.py makes it"
    motions = plans.pop("motions")
    if not motions:
        return None, f"no method has a motion; see {log}"
    began = time.monotonic()
    try:
        rows = score(problem_file, motions, log)
    except Failed as failure:
        return None, str(failure)
    for row, method in zip(rows, motions):
        row["method"] = method
        row["motion"] = row.pop("submission")
    scored = {**plans, "score_s": time.monotonic() - began, "rows": rows}
    (out / "scores.json").write_text(json.dumps(scored, indent=2) + "\n")
    return scored, None


def group(name):
    """Returns the group of a problem in the tables."""
    if is_line(name):
        return f"lines, tool {name.rpartition('-')[2]} mm"
    problem = definition(name)
    if "measured" in problem:
        return "measured maps"
    if "recipes" in problem["recipe"]:
        return "defects"
    return "small maps" if pixels(name) <= SMALL else "large maps"


def valid(scored):
    """Returns the motions that keep the limits and whose bound is above 0."""
    return [row for row in scored["rows"] if row.get("excess") is not None]


def kept(rows):
    """Returns the motions that keep the limits."""
    return [row for row in rows if "time_s" in row]


def recommended(scored):
    """Returns the motion of the recommended plan; None if there is none that keeps the limits."""
    return next(iter(kept(rows_of(scored, "recommended"))), None)


def better(scored):
    """Returns the methods that leave less than the recommended plan, in less time."""
    mine = recommended(scored)
    keys = ("residual_rms_nm", "time_s")
    return [row["method"] for row in kept(scored["rows"]) if mine and all(row[key] < mine[key] for key in keys)]


def median_excess(rows, key):
    """Returns the median excess, in residual or in time; it is infinite without a bound above 0, or without motions."""
    return median([math.inf if row[key] is None else row[key] for row in rows]) if rows else math.inf


def least_excess(row):
    """Returns the excess over what dwell times at any place reach: the excess over the least residual is no smaller."""
    reached = row["reached_rms_nm"]
    return max(row["residual_rms_nm"] / reached - 1, 0) if reached else math.inf


def print_recommended(scored):
    """Prints how the recommended plans stand: which are the best ones, and their median excess in residual and time."""
    for g in sorted({group(name) for name in scored}):
        ones = [one for name, one in scored.items() if group(name) == g]
        rows = list(filter(None, map(recommended, ones)))
        beaten = sum(bool(better(one)) for one in ones)
        in_residual, in_time = (percent(median_excess(rows, key)) or "infinite" for key in ("excess", "excess_time"))
        print(
            f"{g}: {len(rows)} recommended plans, {beaten} of them with another that leaves less in less time; median "
            f"excess {in_residual} % in residual, {in_time} % in time"
        )


def percent(number):
    """Returns an excess in percent; nothing if it has no bound."""
    if number is None or not math.isfinite(number):
        return ""
    return f"{100 * number:.1f}" if number <= 100 else "over 10000"


def write_csv(file, columns, rows):
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("w", newline="") as stream:
        csv.writer(stream, lineterminator="\n").writerows([columns, *rows])


def write_tables(scored, out, tables):
    """Writes every score, and the tables of methods, problems, lines, plans and solvers."""
    rows = [
        [name, row["method"], *(row.get(column) for column in COLUMNS), row.get("refused")]
        for name, one in scored.items()
        for row in one["rows"]
    ]
    write_csv(out / "scores.csv", ["problem", "method", *COLUMNS, "refused"], rows)
    write_csv(tables / "benchmark-methods.csv", *methods_table(scored))
    write_csv(tables / "benchmark-problems.csv", *problems_table(scored))
    write_csv(tables / "benchmark-lines.csv", *lines_table(out))
    write_csv(tables / "benchmark-plans.csv", *plans_table(out))
    write_csv(tables / "benchmark-solvers.csv", *solvers_table(out))


def methods_table(scored):
    """Returns the median excess of every method in every group of problems, in residual and in time, %.

    A method that keeps the limits on fewer problems than it ran on has both numbers beside its median.
    """
    groups = sorted({group(name) for name in scored})
    methods = sorted({row["method"] for one in scored.values() for row in one["rows"]})
    counts = {g: sum(group(name) == g for name in scored) for g in groups}
    columns = ["method"]
    for g in groups:
        columns += [f"{g} ({counts[g]}): kept", "residual, %", "time, %"]
    table = []
    for method in ["recommended", *methods]:
        cells = [method]
        for g in groups:
            rows = [row for name in scored if group(name) == g for row in rows_of(scored[name], method)]
            good = kept(rows)
            if not rows:
                cells += ["not run", "", ""]
                continue
            cells.append(f"{len(good)} of {len(rows)}")
            cells += [percent(median_excess(good, key)) for key in ("excess", "excess_time")]
        table.append(cells)
    return columns, table


def rows_of(one, method):
    if method == "recommended":
        method = one["recommended"]
    return [row for row in one["rows"] if row["method"] == method]


def problems_table(scored):
    """Returns the best and the recommended method of every problem, and every problem that has not run."""
    columns = ["problem", "pixels", "motions", "least excess, %", "by", "recommended", "its excess, %: at least"]
    columns += ["at most", "in time, %", "less in less time", "bound, nm", "time, s", "planning, s", "scoring, s"]
    table = []
    for name in by_pixels(problem_names()):
        if name not in scored:
            table.append([name, pixels(name) or "", "not run", *[""] * 11])
            continue
        one = scored[name]
        rows = valid(one)
        best = min(rows, key=lambda row: row["excess"], default=None)
        mine = recommended(one)
        cells = [name, pixels(name), len(kept(one["rows"]))]
        cells += [percent(best["excess"]), best["method"]] if best else ["", ""]
        if mine:
            cells += [mine["method"], percent(least_excess(mine))]
            cells += [percent(mine["excess"]), percent(mine["excess_time"]), " ".join(better(one))]
            cells += [f"{mine['bound_rms_nm']:.4g}", f"{mine['time_s']:.1f}"]
        else:
            cells += ["none", "", "", "", "", "", ""]
        table.append(cells + [f"{one['plan_s']:.0f}", f"{one['score_s']:.0f}"])
    return columns, table


def plans_table(out):
    """Returns residual and time of the plans of every problem that is planned, scored or not, as their reports say."""
    plans = [f"first path, {plan}" for plan in ("joint", "pvt+refined", "pvt")]
    plans += [f"{path}, pvt+refined" for path in OTHER_PATHS]
    columns = ["problem", "pixels", "before, nm", "recommended"]
    for one in plans:
        columns += [f"{one}: nm", "s"]
    table = []
    for name in by_pixels(problem_names()):
        folder = out / "runs" / name
        if not (folder / "planned.json").exists():
            continue
        cells = [name, pixels(name), "", ""]
        for one in plans:
            path, method = one.split(", ")
            file = folder / path.replace("first path", "line" if is_line(name) else "raster") / "report/summary.json"
            summary = json.loads(file.read_text()) if file.exists() else {"methods": {}}
            if path == "first path" and summary["methods"]:
                cells[2:4] = [f"{summary['initial']['rms_nm']:.4g}", summary["best"]]
            row = summary["methods"].get(method)
            if row and row["limits_respected"]:
                cells += [f"{row['rms_nm']:.4f}", f"{row['total_time_s']:.0f}"]
            else:
                cells += ["", ""]
        table.append(cells)
    return columns, table


def solvers_table(out):
    """Returns the dwell solvers: medians over the small maps of what they leave and take, over bounded least squares.

    The dwell times lie along the raster and PVT executes them.
    """
    ratios = {}
    for file in sorted(out.glob("runs/*/solvers/report/summary.json")):
        solvers = json.loads(file.read_text())["solvers"]
        first = solvers["bounded-least-squares"]
        for solver, row in solvers.items():
            keys = ("position_rms_nm", "executed_rms_nm", "executed_time_s")
            numbers = [row[key] / first[key] if row[key] else math.inf for key in keys]
            ratios.setdefault(solver, []).append(numbers)
    columns = ["solver", "maps", "residual at the dwell points", "executed residual", "executed time"]
    medians = {solver: [median(column) for column in zip(*rows)] for solver, rows in ratios.items()}
    ordered = sorted(medians.items(), key=lambda item: item[1][1])
    return columns, [[solver, len(ratios[solver]), *(f"{v:.3f}" for v in row)] for solver, row in ordered]


def lines_table(out):
    """Returns the slopes of every planned mirror line before and after its recommended plan, and what its file says."""
    columns = ["line", "laboratory", "year", "stated slopes, nrad", "tool, mm", "slopes before, nrad", "after"]
    columns += ["heights before, nm", "after", "time, s"]
    table = []
    for name in filter(is_line, problem_names()):
        plans = out / "runs" / name / "line"
        summary_file = plans / "report/summary.json"
        if not summary_file.exists():
            continue
        summary = json.loads(summary_file.read_text())
        if summary["best"] is None:
            continue
        about = json.loads((measured_folder(definition(name)) / "about.json").read_text())
        maps = [plans / "surface/height_nm.npy", plans / f"methods/{summary['best']}/removal/residual_nm.npy"]
        before, after = (middle_row(file) for file in maps)
        step_mm = array(plans / "surface/x_mm.npy")[1][1] - array(plans / "surface/x_mm.npy")[1][0]
        stated = about["slopes_nrad"]
        _, number, _, sigma = name.split("-")
        cells = [number, about["laboratory"], about["year"], f"{stated:.0f}" if stated else "", sigma]
        cells += [f"{slope_rms(before, step_mm):.0f}", f"{slope_rms(after, step_mm):.1f}"]
        cells += [f"{deviation(before):.3f}", f"{deviation(after):.4f}"]
        cells.append(f"{summary['methods'][summary['best']]['total_time_s']:.0f}")
        table.append(cells)
    return columns, table


def middle_row(file):
    (rows, columns), heights = array(file)
    return heights[columns * (rows // 2) :][:columns]


def slope_rms(heights_nm, step_mm):
    """Returns the RMS of the slopes between neighbours without their mean, nrad."""
    return 1e3 * deviation([(b - a) / step_mm for a, b in zip(heights_nm, heights_nm[1:])])


def deviation(numbers):
    mean = sum(numbers) / len(numbers)
    return math.sqrt(sum((number - mean) ** 2 for number in numbers) / len(numbers))


def compare_with_finer(names, out):
    """Prints for each problem how many pairs of methods have the same order on a map with half the pitch.

    Pairs whose residuals differ by less than 1 % on either map do not count.
    """
    for name in names:
        problem = definition(name)
        recipe = json.loads((FOLDER / problem["recipe"]).read_text())
        recipe["pixels"] = [2 * n - 1 for n in recipe["pixels"]]
        folder = out / "finer"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}-recipe.json").write_text(json.dumps(recipe))
        files = {key: str(FOLDER / problem[key]) for key in ("machine", "error_budget")}
        finer = folder / f"{name}.json"
        finer.write_text(json.dumps(problem | files | {"recipe": str(folder / f"{name}-recipe.json")}))
        (coarse, why), (fine, why_fine) = run(name, out), run(name, folder, finer)
        if why or why_fine:
            print(f"{name}: left out: {why or why_fine}", file=sys.stderr)
            continue
        left, right = ({row["method"]: row["excess"] for row in valid(one)} for one in (coarse, fine))
        pairs = same = 0
        for a, b in combinations(sorted(left.keys() & right.keys()), 2):
            ratios = [(1 + side[a]) / (1 + side[b]) for side in (left, right)]
            if all(max(ratio, 1 / ratio) > 1.01 for ratio in ratios):
                pairs += 1
                same += (ratios[0] > 1) == (ratios[1] > 1)
        best = [min(side, key=side.get, default="none") for side in (left, right)]
        print(f"| {name} | {same} of {pairs} | {best[0]} | {best[1]} |", flush=True)


def print_errors(names, out):
    """Prints the residuals of the recommended plans with the errors of the process."""
    for name in names:
        scored, reason = run(name, out)
        mine = recommended(scored) if scored else None
        if mine is None:
            print(f"{name}: left out: {reason or 'no plan is recommended'}", file=sys.stderr)
            continue
        log = out / "runs" / name / "log.txt"
        code, text = start("planish-benchmark", "score", FOLDER / f"{name}.json", mine["motion"], log=log)
        if code:
            print(f"{name}: left out: see {log}", file=sys.stderr)
            continue
        drawn = json.loads(text)["with_errors"]
        numbers = [mine["residual_rms_nm"], drawn["median_nm"], drawn["below_95_percent_nm"]]
        print(f"| {name} | {mine['method']} | {' | '.join(f'{number:.4f}' for number in numbers)} |", flush=True)


def compare_defaults(names, out, jobs, tables):
    """Runs joint plans with other values of their settings, and writes their residuals, times and excesses.

    Prints the median of each over the maps, relative to the plan with the defaults.
    """
    rows, ratios = [], {}
    for name in names:
        try:
            scored = plans_with_other_values(name, out, jobs)
        except Failed as failure:
            print(f"{name}: left out: {failure}", file=sys.stderr)
            continue
        first = scored.get("default")
        if first is None:
            print(f"{name}: left out: see {out / 'defaults' / name / 'log.txt'}", file=sys.stderr)
            continue
        for choice, one in scored.items():
            row = [f"{one['residual_rms_nm']:.4f}", f"{one['time_s']:.1f}"]
            rows.append([name, choice, *row, percent(one["excess"]), percent(one["excess_time"])])
            residual, time_ratio = (one[key] / first[key] for key in ("residual_rms_nm", "time_s"))
            excesses = [1 + median_excess([score], "excess_time") for score in (one, first)]
            numbers = [residual, time_ratio, residual**2 * time_ratio**0.5, excesses[0] / excesses[1]]
            ratios.setdefault(choice, []).append(numbers)
        print(f"{name}: {len(scored)} plans", file=sys.stderr, flush=True)
    columns = ["problem", "choice", "residual, nm", "time, s", "excess in residual, %", "in time, %"]
    write_csv(tables / "benchmark-defaults.csv", columns, rows)
    for choice, numbers in ratios.items():
        medians = " | ".join(f"{median(column):.2f}" for column in zip(*numbers))
        print(f"| {choice} | {len(numbers)} | {medians} |")


def plans_with_other_values(name, out, jobs):
    """Returns the scores of the joint plans that keep the limits, by the setting that is not the default.

    A line has one pass, and no width of the tool: its other values are those without a unit.
    """
    folder = out / "defaults" / name
    folder.mkdir(parents=True, exist_ok=True)
    log, problem = folder / "log.txt", definition(name)
    settings = part(name, problem, folder, log)
    if settings is None:
        print(f"{name}: its part is missing; benchmark/measured.py makes it", file=sys.stderr)
        return {}
    pipeline, settings = pipeline_of(name, settings | {"machine": FOLDER / problem["machine"]})
    settings |= {"refine": "no", "plan_joint": "yes", "frames": 0}
    plans = {"default": (pipeline, settings)}
    for key, value, unit in OTHER_VALUES:
        if is_line(name) and (unit or key in ("scan", "path")):
            continue
        changed = {key: value * width_mm(settings["tif"]) if unit else value}
        plans[f"{key} {value} {unit}".strip()] = (changed.pop("path", pipeline), settings | changed)
    fast_problem = problem_with_fast_machine(problem, folder)
    plans[FAST] = (pipeline, settings | {"machine": folder / "machine.json"})
    with ThreadPoolExecutor(jobs) as pool:
        runs = {
            choice: pool.submit(run_pipeline, *plan, folder / choice.replace(" ", "-"), log)
            for choice, plan in plans.items()
        }
    for choice, one in runs.items():
        if one.exception():
            print(f"{name}, {choice}: left out: {one.exception()}", file=sys.stderr)
    motions = {choice: folder / choice.replace(" ", "-") / "methods/joint/trajectory" for choice in plans}
    motions = {choice: motion for choice, motion in motions.items() if motion.exists()}
    fast = {choice: motions.pop(choice) for choice in [FAST] if choice in motions}
    return joint_scores(FOLDER / f"{name}.json", motions, log) | joint_scores(fast_problem, fast, log)


def problem_with_fast_machine(problem, folder):
    """Writes the problem with a machine whose limits are 100 times as large, and returns its file.

    Its plan shows which part of an excess the limits cause: the rest is that of the path.
    """
    machine = json.loads((FOLDER / problem["machine"]).read_text())
    for axis in machine["axes"]:
        axis |= {key: 100 * value for key, value in axis.items() if key.startswith("max_")}
    (folder / "machine.json").write_text(json.dumps(machine))
    files = {key: str(FOLDER / problem[key]) for key in ("recipe", "error_budget") if key in problem}
    if "measured" in problem:
        files["measured"] = problem["measured"] | {"folder": str(measured_folder(problem))}
    file = folder / "problem.json"
    file.write_text(json.dumps(problem | files | {"machine": str(folder / "machine.json")}))
    return file


def joint_scores(problem_file, motions, log):
    """Returns the scores of the motions that keep the limits, by their choices."""
    rows = score(problem_file, motions, log) if motions else []
    return {choice: row for choice, row in zip(motions, rows) if "time_s" in row}


def problem_names():
    return sorted(file.stem for file in FOLDER.glob("*.json"))


def by_pixels(names):
    return sorted(names, key=lambda name: (pixels(name), name))


def run_all(names, out, jobs):
    """Runs the problems. Returns the scores of each, and whether a problem failed."""
    scored, failed = {}, False
    with ThreadPoolExecutor(jobs) as pool:
        tasks = {pool.submit(run, name, out): name for name in names}
        for task in as_completed(tasks):
            name, (one, reason) = tasks[task], task.result()
            if reason:
                print(f"{name}: left out: {reason}", file=sys.stderr, flush=True)
                failed |= "missing" not in reason
                continue
            scored[name] = one
            best = min(valid(one), key=lambda row: row["excess"], default=None)
            if best:
                print(
                    f"{name:28} {best['method']:36} {best['time_s']:8.1f} s {best['residual_rms_nm']:9.4f} nm, bound "
                    f"{best['bound_rms_nm']:9.4f} nm, excess {percent(best['excess']):>6} %, "
                    f"{one['plan_s']:.0f} + {one['score_s']:.0f} s",
                    flush=True,
                )
    return {name: scored[name] for name in names if name in scored}, failed


def main():
    parser = argparse.ArgumentParser(description="Run and score the methods on the problems of the benchmark.")
    parser.add_argument("problems", nargs="*", help="names of problems; all if none is given")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="problems at the same time")
    parser.add_argument("--out", type=Path, default=ROOT / "out/benchmark", help="runs and scores")
    parser.add_argument("--tables", type=Path, help="folder of the tables")
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--scored", action="store_true", help="no runs: tables of the problems that have scores")
    kind.add_argument("--finer", action="store_true", help="order of the methods on a map with half the pitch")
    kind.add_argument("--errors", action="store_true", help="recommended plans with the errors of the process")
    kind.add_argument("--defaults", action="store_true", help="other values of the settings, one at a time")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.problems if not (FOLDER / f"{name}.json").exists()]
    if unknown:
        sys.exit(f"{unknown[0]}: no problem of benchmark/problems")
    names, out = by_pixels(arguments.problems or problem_names()), arguments.out.resolve()
    if arguments.finer:
        return compare_with_finer(names, out)
    if arguments.errors:
        return print_errors(names, out)
    if arguments.defaults:
        return compare_defaults(names, out, arguments.jobs, arguments.tables or out)
    if arguments.scored:
        names = [name for name in names if scores_of(out, name)]
    scored, failed = run_all(names, out, arguments.jobs)
    if scored:
        write_tables(scored, out, arguments.tables or out)
        print_recommended(scored)
        every = [row for one in scored.values() for row in valid(one)]
        # The bound is (1) of its module in double precision.
        below = [row["motion"] for row in every if row["excess"] < -1e-9]
        print(f"{len(below)} of {len(every)} motions are below the bound")
        minutes = {key: sum(one[key] for one in scored.values()) / 60 for key in ("plan_s", "score_s")}
        print(f"{minutes['plan_s']:.0f} min of planning and {minutes['score_s']:.0f} min of scoring")
        if below:
            sys.exit(f"the bound is wrong, or the score: {below[0]}")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
