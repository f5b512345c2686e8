"""Opens report.html in headless Chromium, uses it as a person would, and compares what it shows
with the files beside it.

    browser.py REPORT_DIR RUN_DIR [--shots DIR]     a report of one run, and the run
    browser.py --several REPORT_DIR [--shots DIR]   a report of several runs
    browser.py --tools RUN_DIR [--shots DIR]        a run of several tools, with its page
    browser.py --docs REPORT_DIR PICTURE_DIR        the pictures of docs/report.md
    browser.py --hostile PLANISH_BIN_DIR RUN_DIR    a copy of the run with names that are programs
    browser.py --large PLANISH_BIN_DIR WORK_DIR     a mirror of 1641 x 1641 with 2.5e5 segments

Needs chromium (Debian package), numpy and websocket-client. Exit code 1 when a check fails.
"""

import argparse
import json
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile
import time

import numpy as np

from chromium import FAILED, Browser, check, on_screen, panel, read_text


def check_table(browser, report):
    summary = json.loads((report / "summary.json").read_text())
    runs = summary.get("runs", [summary])
    methods = [m for run in runs for m in run["methods"].values()]
    beside = ("execution", "specification", "remarks", "machine", "places", "low_order")
    wanted = [{k: v for k, v in {**m, **m["execution"]}.items() if k not in beside} for m in methods]
    cells = browser.js("[...document.querySelectorAll('#summary td')].map((c) => [c.dataset.key, +c.dataset.entry, c.dataset.value, c.textContent, c.className])")
    shown = {(key, entry): (json.loads(value), text) for key, entry, value, text, _ in cells}
    check("the table has every number of every method", len(shown) == sum(len(m) for m in wanted), len(shown))
    wrong = []
    for entry, method in enumerate(wanted):
        for key, value in method.items():
            data, text = shown.get((key, entry), (None, ""))
            if data != value:
                wrong.append((key, entry, data, value))
            if isinstance(value, (int, float)) and not isinstance(value, bool):
                decimals = len(text.split(".")[1]) if "." in text else 0
                if abs(float(text) - value) > 0.5000001 * 10**-decimals:
                    wrong.append((key, entry, text, value))
    check("the numbers equal summary.json", not wrong, wrong[:3] or f"{len(shown)} cells")
    kept = [m for m in wanted if m["limits_respected"] and m["plan"]["state"] not in ("without-motion", "baseline")] or wanted
    best = [(k, e) for k, e, _, _, c in cells if c == "best" and k == "rms_nm"]
    least = min(m["rms_nm"] for m in kept)
    plans = [text for _, text in sorted((entry, text) for key, entry, _, text, _ in cells if key == "plan")]
    check("how good every plan is known to be stands in the table", plans == [m["plan"]["word"] for m in wanted], plans)
    judged = [l for run in runs for j in [run["specification"]["before"], *(m["specification"] for m in run["methods"].values()),
              run["specification"]["after"]] if j for l in j["limits"]]
    values = browser.js("[...document.querySelectorAll('#specifications td[data-value]')].map((c) => [JSON.parse(c.dataset.value), c.textContent])")
    key = lambda v: (v[0] is None, v[0] or 0, v[1])
    wanted_limits = sorted(((l["value"], not l["passed"]) for l in judged), key=key)
    shown_limits = sorted(((value, text.endswith(" exceeded")) for value, text in values), key=key)
    check("every limit of the specification stands in its table", shown_limits == wanted_limits, len(values))
    near = all(v is None or abs(float(text.split()[0]) - v) <= 1e-3 * abs(v) for v, text in values)
    check("with its value to four digits", near)
    notes = browser.js("document.getElementById('notes').textContent")
    check("and why, below it", all(m["plan"]["text"] in notes for m in wanted))
    signed = browser.js("[...document.querySelectorAll('td, p, li, .read, output')].map((e) => e.textContent).filter((t) => /-0(\\.0+)?(?![\\d.e])/.test(t))")
    check("no zero has a sign", signed == [], signed[:3] or "")
    bands = browser.js("[...document.querySelectorAll('#bands tr')].slice(1).map((r) => [...r.querySelectorAll('td')].map((c) => c.textContent))")
    added = lambda row: sum(float(v) ** 2 for v in row[:-1] if v != "-") ** 0.5
    sums = all(row[-1] == "-" or abs(added(row) - float(row[-1])) <= 2e-3 * float(row[-1]) for row in bands)
    check("the squares of the bands add up to that of the RMS", bands != [] and sums, bands)
    starred = {(k, e) for k, e, _, _, c in cells if c == "best"}
    limited = ("max_velocity_mm_per_s", "max_acceleration_mm_per_s2", "overshoot_points", "max_overshoot_mm")
    check("what is limited and not minimised has no star", not any(k in limited for k, _ in starred), starred)
    steps = {e for e, m in enumerate(wanted) if max(m["max_acceleration_step_mm_per_s2"]) >= 0.05}
    check("no star for the jerk where the acceleration steps", not any(k == "max_jerk_mm_per_s3" and e in steps for k, e in starred), steps)
    check("the best of a row is marked", len(wanted) == 1 or all(wanted[e]["rms_nm"] == least for _, e in best) and best != [], best)


NUMBER = r"(-?[\d.]+(?:e-?\d+)?)"
SENTENCE = re.compile(
    rf"^(?P<name>\S+) runs on (?P<machine>\S+) in {NUMBER} (s|min|h): {NUMBER} to {NUMBER} nm RMS"
    rf"(?: \({NUMBER} in waves shorter than the tool corrects\))?"
    rf", worst {NUMBER} nm from the mean at x {NUMBER}, y {NUMBER} mm; the limits of the machine are kept")


def runs_of(report):
    summary = json.loads((report / "summary.json").read_text())
    return summary.get("runs", [summary])


def check_answer(browser, report):
    """The answer stands first, and every number in it is that of the summary."""
    runs = runs_of(report)
    texts = "((i) => ((look) => [...document.querySelectorAll(`${look}[data-answer='${i}']`)].map((e) => e.textContent)))"
    shown = [browser.js(f"((all) => [all('.sentence')[0], all('.violation'), all('.why')[0], all('.still')[0] ?? null])({texts}({i}))") for i in range(len(runs))]
    wanted = [[a["sentence"], a["problems"], a["why"], a["without_motion"]] for a in (run["answer"] for run in runs)]
    check("the answer of every run is that of summary.json", shown == wanted, shown[0][0])
    for run, (sentence, _, why, still_text) in zip(runs, shown):
        found = SENTENCE.match(sentence)
        check("the answer says plan, machine, time, RMS and worst place", found is not None, sentence)
        if found is None:
            continue
        m = run["methods"][run["best"]]
        value, unit, *numbers = found.groups()[2:]
        # Rounded to three digits, places to 0.1 mm.
        near = lambda text, v, slack: text is None and v is None or abs(float(text) - v) <= slack
        three = lambda v: 0 if v is None else 0.00501 * abs(v)
        worst = m["places"]["worst"][0]
        values = [run["initial"]["rms_nm"], m["rms_nm"], m["short_wave_rms_nm"], worst["from_mean_nm"]]
        time_s = float(value) * {"s": 1, "min": 60, "h": 3600}[unit]
        ok = found["name"] == run["best"] and found["machine"] == m["machine"] and abs(time_s - m["total_time_s"]) <= three(m["total_time_s"])
        ok = ok and all(near(t, v, three(v)) for t, v in zip(numbers, values))
        ok = ok and all(near(t, v, 0.0501) for t, v in zip(numbers[4:], (worst["x_mm"], worst["y_mm"])))
        check("its numbers are those of the plan that is to be run", ok, numbers)
        check("and why this one", run["best"] in why and m["plan"]["text"] in why)
        still = [n for n, o in run["methods"].items() if o["plan"]["state"] == "without-motion"]
        check("dwell times without a motion are called no plan", all(still_text.startswith("Not a plan: " + n) for n in still))
        labels = browser.js("planish.ENTRIES.filter((e) => e.run.summary.methods[e.method.name].plan.state === 'without-motion').map((e) => e.label)")
        check("wherever it stands", all(label.endswith("(without a motion)") for label in labels), labels)
    tops = browser.js("['#answer', '#maps', '#bar', '#reasons', '#summary', '#surfaces'].map((s) => document.querySelector(s).getBoundingClientRect().top)")
    check("the answer comes first, then the maps, then reasons and tables", tops == sorted(tops), tops)
    heads = browser.js("[...document.querySelectorAll('#summary thead th')].map((e) => e.textContent)")
    best = [run["best"] for run in runs if run["best"]]
    check("the plan that is to be run is the first column", heads[1].endswith("to be run") and any(b in heads[1] for b in best), heads[1])
    bad = browser.js("[...document.querySelectorAll('.bad, .violation')].map((e) => e.textContent)")
    problems = [p for run in runs for p in run["answer"]["problems"]]
    spoken = all(p in bad for p in problems)
    unseen = browser.js("[...document.querySelectorAll('.bad, .violation')].filter((e) => e.closest('details') && !e.closest('#answer, #reasons')).length")
    check("and nothing red folds among the notes", unseen == 0, unseen)
    check("red is only what concerns that plan", spoken and (problems != [] or bad == []), bad[:2])


def check_places(browser, report, run):
    """What remains where: every number of every method, and by other means that of the one that is shown."""
    chosen = browser.js("planish.state.a")
    wrong, count = [], 0
    for entry in range(browser.js("planish.ENTRIES.length")):
        browser.js(f"(() => {{ const s = document.getElementById('a'); s.value = {entry}; s.dispatchEvent(new Event('change')); }})()")
        browser.settle()
        cells = browser.js("[...document.querySelectorAll('[data-path]')].map((c) => [JSON.parse(c.dataset.path), +c.dataset.run, c.textContent])")
        for path, number, text in cells:
            value = runs_of(report)[number]
            for key in path:
                value = value[key]
            digits = re.search(r"-?\d+(?:\.(\d+))?", text)
            near = text == "-" if value is None else abs(float(digits[0]) - value) <= 0.5000001 * 10 ** -len(digits[1] or "")
            count += 1
            if not near:
                wrong.append((path, text, value))
    check("every number about places equals summary.json", wrong == [] and count > 40, wrong[:2] or f"{count} numbers")
    browser.js(f"(() => {{ const s = document.getElementById('a'); s.value = {chosen}; s.dispatchEvent(new Event('change')); }})()")
    browser.settle()

    method = browser.js(f"planish.ENTRIES[{chosen}].method.name")
    summary = runs_of(report)[0]
    places = summary["methods"][method]["places"]
    z = np.load(run / "methods" / method / "removal/residual_nm.npy")
    x, y = np.load(run / "surface/x_mm.npy"), np.load(run / "surface/y_mm.npy")
    off = z - np.nanmean(z)
    r, c = np.unravel_index(np.nanargmax(np.abs(off)), off.shape)
    first = places["worst"][0]
    same = [abs(first["x_mm"] - x[c]), abs(first["y_mm"] - y[r]), abs(first["from_mean_nm"] - off[r, c])]
    check("the worst place is that of the array", max(same) < 1e-9, first)
    rate = np.load(run / "fixture/tif/rate_nm_per_s.npy")
    tx, ty = np.load(run / "fixture/tif/x_mm.npy"), np.load(run / "fixture/tif/y_mm.npy")
    radius = np.sqrt((rate >= 0.5 * rate.max()).sum() * (tx[1] - tx[0]) * (ty[1] - ty[0]) / np.pi)
    dx, dy = x[1] - x[0], y[1] - y[0]
    nr, nc = int(np.ceil(radius / dy)), int(np.ceil(radius / dx))
    invalid = np.pad(np.isnan(z), ((nr, nr), (nc, nc)), constant_values=True)
    near = np.zeros(z.shape, bool)
    for i in range(-nr, nr + 1):
        for j in range(-nc, nc + 1):
            if np.hypot(i * dy, j * dx) < radius:
                near |= invalid[nr + i:nr + i + z.shape[0], nc + j:nc + j + z.shape[1]]
    near &= ~np.isnan(z)
    wanted = [radius, np.sqrt(np.mean(off[near] ** 2)), np.sqrt(np.mean(off[~near & ~np.isnan(z)] ** 2))]
    found = [summary["division"]["edge_width_mm"], places["zone_rms"]["edge_nm"], places["zone_rms"]["inside_nm"]]
    check("so are the edge zone and the inside", np.allclose(found, wanted, rtol=1e-9), found)
    t = np.diff(np.load(run / "methods" / method / "trajectory/break_time_s.npy"))
    k = np.load(run / "methods" / method / "trajectory/coefficient_mm.npy")
    u = t[:, None] * np.linspace(0, 1, 65)
    at = sum(k[:, :, None, p] * u[:, None, :] ** p for p in range(4))
    sampled = [[at[:, a].min(), at[:, a].max()] for a in (0, 1)]
    # 65 samples of a cubic miss its extreme by less than 1e-3 of what it moves within its segment.
    slack = 1e-3 * np.abs(at - at[:, :, :1]).max() + 1e-9
    check("and the travel", np.abs(np.array(places["travel_mm"]) - sampled).max() <= slack, places["travel_mm"])
    parts = places["time"]
    total = sum(v or 0 for v in parts.values())
    on_mirror = (parts["edge_s"] or 0) + parts["inside_s"]
    whole = summary["methods"][method]["total_time_s"]
    check("times add up", abs(total - whole) < 1e-6 * whole and abs(np.sum(places["region_time_s"]) - on_mirror) < 1e-6 * whole, parts)

    reach = browser.js("planish.panels.find((p) => p.name === 'residual').content().bar.range[1]")
    wanted = np.nanquantile(np.abs(off), 0.99, method="lower")
    check("the residual has its own scale", abs(reach / wanted - 1) < 1e-9, f"{reach:.4f} nm")
    others = [browser.js(f"planish.panels.find((p) => p.name === '{n}').content().bar.range[1]") for n in ("desired", "removal")]
    check("before and removal share theirs", others[0] == others[1] and others[0] > reach, others)
    marks = browser.js("planish.panels.find((p) => p.name === 'residual').content().marks.map((m) => [...m.at, m.text])")
    check("the worst places are marked", marks == [[w["x_mm"], w["y_mm"], str(i + 1)] for i, w in enumerate(places["worst"])], marks[:2])
    browser.js("document.querySelector('#worst button').click()")
    browser.settle()
    check("and lead to their profiles", browser.js("planish.state.pin") == [first["x_mm"], first["y_mm"]])
    panel(browser, "desired")
    browser.mouse("mouseMoved", *on_screen(browser, "desired", x[len(x) // 3], y[len(y) // 2]))
    browser.settle()
    read = [re.search(r"\[(\d+), (\d+)\]", read_text(browser, n)) for n in ("desired", "removal", "residual")]
    check("the cursor is the same in before, removal and residual", all(read) and len({m[0] for m in read}) == 1, read[0] and read[0][0])


def check_pointer(browser, run, entry):
    """Values under the mouse, and 400 others, against the arrays."""
    method = browser.js(f"planish.ENTRIES[{entry}].method.name")
    rng = np.random.default_rng(1)
    surface = run / "surface"
    x, y = np.load(surface / "x_mm.npy"), np.load(surface / "y_mm.npy")
    arrays = {"desired": np.load(surface / "height_nm.npy"),
              "removal": np.load(run / "methods" / method / "removal" / "removal_nm.npy"),
              "residual": np.load(run / "methods" / method / "removal" / "residual_nm.npy")}
    for name, array in arrays.items():
        layer = f"planish.panels.find((p) => p.name === '{name}').content().layer"
        every, step = browser.js(f"[{layer}.every, {layer}.step]")
        means = array
        if every > 1:
            ny, nx = (-(-n // every) for n in array.shape)
            means = np.array([[np.nanmean(array[r * every:(r + 1) * every, c * every:(c + 1) * every]) for c in range(nx)] for r in range(ny)])
        shown = np.array(browser.js(f"[...{layer}.values()].map((v) => Number.isNaN(v) ? 1e99 : v)")).reshape(means.shape)
        shown[shown == 1e99] = np.nan
        same_nan = (np.isnan(shown) == np.isnan(means)).all()
        worst = np.nanmax(np.abs(shown - means))
        check(f"{name}: all {means.size} values equal the array to half a step", same_nan and worst <= 0.501 * step, f"{worst:.2e} of {step:.2e} nm, every {every}")
        panel(browser, name)
        found = []
        for _ in range(5):
            r, c = rng.integers(0, means.shape[0]), rng.integers(0, means.shape[1])
            if np.isnan(means[r, c]):
                continue
            at = on_screen(browser, name, x[0] + (c * every + (every - 1) / 2) * (x[1] - x[0]), y[0] + (r * every + (every - 1) / 2) * (y[1] - y[0]))
            browser.mouse("mouseMoved", *at)
            browser.settle()
            text = read_text(browser, name)
            # The mouse stands on whole pixels of the screen: the text says which pixel it reads.
            row, column = json.loads("[" + text.split("[")[1].split("]")[0] + "]")
            value = float(text.split("]: ")[1].split(" nm")[0])
            near = abs(row - r) * (y[1] - y[0]) * every < 1 and abs(column - c) * (x[1] - x[0]) * every < 1
            found.append(near and abs(value - means[row, column]) <= step + 1e-5 * abs(value))
        check(f"{name}: what the pointer reads", all(found) and len(found) > 0, f"{sum(found)} of {len(found)}")


def check_slopes(browser, report, run, entry):
    """The folded slope maps: shown when unfolded, and equal to the differences of the arrays."""
    summary = json.loads((report / "summary.json").read_text())
    method = browser.js(f"planish.ENTRIES[{entry}].method.name")
    blank = browser.js("planish.panels.filter((p) => p.name.startsWith('slope-')).every((p) => !p.canvas.checkVisibility())")
    check("slope maps fold", blank)
    browser.js("document.getElementById('slopes').open = true")
    browser.settle()
    every = browser.js(f"planish.ENTRIES[{entry}].residual.every")
    x, y = np.load(run / "surface/x_mm.npy"), np.load(run / "surface/y_mm.npy")
    maps = {"before": (np.load(run / "surface/height_nm.npy"), summary["initial"]["slope_rms_nrad"], "desired"),
            "after": (np.load(run / "methods" / method / "removal/residual_nm.npy"), summary["methods"][method]["slope_rms_nrad"], "residual")}
    for when, (z, rms, layer) in maps.items():
        for axis, step in ((0, x[1] - x[0]), (1, y[1] - y[0])):
            name = f"slope-{when}-{'xy'[axis]}"
            steps = max(1, round(summary["slope_base_mm"][axis] / step))
            wanted = 1000 * (z[:, steps:] - z[:, :-steps] if axis == 0 else z[steps:] - z[:-steps]) / (steps * step)
            content = f"planish.panels.find((p) => p.name === '{name}').content()"
            if every == 1:
                shown = np.array(browser.js(f"[...{content}.layer.values()].map((v) => Number.isNaN(v) ? 1e99 : v)")).reshape(wanted.shape)
                shown[shown == 1e99] = np.nan
                # Two heights, each to half a step of the page.
                slack = 1000 * 1.002 * browser.js(f"planish.ENTRIES[{entry}].{'residual' if when == 'after' else 'run.desired'}.step") / (steps * step)
                same = (np.isnan(shown) == np.isnan(wanted)).all() and np.nanmax(np.abs(shown - wanted)) <= slack
                check(f"{name}: the slopes are those of the array", same, f"{np.nanmax(np.abs(shown - wanted)):.2e} of {slack:.2e} nrad")
                place = browser.js(f"(() => {{ const l = {content}.layer; return [l.x0, l.y0]; }})()")
                middle = [x[0] + (axis == 0) * steps * step / 2, y[0] + (axis == 1) * steps * step / 2]
                check(f"{name}: at the middle between the pixels", np.allclose(place, middle, atol=1e-9), place)
            check(f"{name}: its RMS is that of summary.json", abs(np.nanstd(wanted) / rms[axis] - 1) < 1e-9, rms[axis])
            read = re.search(NUMBER + " nrad RMS", browser.js(f"planish.panels.find((p) => p.name === '{name}').title.textContent"))
            check(f"{name}: and stands above it", read is not None and abs(float(read[1]) / rms[axis] - 1) < 5.01e-4, read and read[1])
            colours = browser.js(f"(() => {{ const c = document.querySelector('[data-panel={name}]'), d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data, s = new Set(); for (let i = 0; i < d.length; i += 4) s.add(d[i] << 16 | d[i+1] << 8 | d[i+2]); return s.size; }})()")
            check(f"{name}: it is drawn", colours > 20, colours)
    browser.js("document.getElementById('slopes').open = false")
    browser.settle()


def check_hand(browser):
    """The range of the colours, typed: both maps take it, and what is not above zero changes nothing."""
    choose = "((v) => { const s = document.getElementById('scale'); s.value = v; s.dispatchEvent(new Event('change')); })"
    enter = "((v) => { const s = document.getElementById('hand-nm'); s.value = v; s.dispatchEvent(new Event('input')); })"
    ranges = "['desired', 'residual'].map((n) => planish.panels.find((p) => p.name === n).content().bar.range)"
    own = browser.js(ranges)
    check("the field of the range hides until it is wanted", not browser.js("document.getElementById('hand-nm').checkVisibility()"))
    browser.js(choose + "('hand')")
    browser.settle()
    # The field has three digits.
    start = browser.js(ranges)
    near = abs(start[1][1] / own[1][1] - 1) < 5.01e-3
    check("a range by hand begins with that of the residual", start[0] == start[1] and near and browser.js("document.getElementById('hand-nm').checkVisibility()"), start)
    browser.js(enter + "('0.75')")
    browser.settle()
    check("the typed range is that of both maps", browser.js(ranges) == [[-0.75, 0.75]] * 2)
    for wrong in ("0", "-1", ""):
        browser.js(enter + f"('{wrong}')")
        browser.settle()
        marked = browser.js("[document.getElementById('hand-nm').getAttribute('aria-invalid'), document.getElementById('hand-nm').validationMessage]")
        check(f"a range of '{wrong}' is marked and changes nothing", browser.js(ranges) == [[-0.75, 0.75]] * 2 and marked == ["true", "A height above 0 nm."], marked)
    browser.js(enter + "('0.75')")
    browser.js(choose + "('apart')")
    browser.settle()
    check("the other scales are as before", browser.js(ranges) == own)


def check_front(browser, report, shots=None):
    """Residual against time: every plan of the table is a point, and the button saves the file beside the page."""
    points = browser.js("planish.DATA.front.points.map((p) => [p.run, p.plan, p.time_s, p.rms_nm, p.is_recommended])")
    wanted = [[run["best"] == name, m["total_time_s"], m["rms_nm"]] for run in runs_of(report) for name, m in run["methods"].items()]
    check("every plan is a point of residual and time", sorted([p[4], p[2], p[3]] for p in points) == sorted(wanted), len(points))
    shown = browser.js("document.getElementById('front').checkVisibility()")
    check("two plans or more have a picture", shown == (len(points) > 1), len(points))
    if shown:
        browser.js("document.getElementById('front').scrollIntoView({block: 'center'})")
        browser.settle()
        best = next(i for i, p in enumerate(points) if p[4])
        x, y = browser.js(f"(() => {{ const r = document.getElementById('front').getBoundingClientRect(), p = drawFront.places[{best}]; return [r.left + p[0] + 2, r.top + p[1] + 2]; }})()")
        browser.mouse("mouseMoved", x, y)
        browser.settle()
        read = browser.js("document.getElementById('front-read').textContent")
        check("the pointer reads the plan to be run", read.startswith(points[best][1]) and "limits kept" in read, read)
    saved = pathlib.Path(tempfile.mkdtemp(prefix="planish-saved-"))
    browser.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(saved))
    browser.js("document.getElementById('front-csv').click()")
    for _ in range(100):
        if list(saved.glob("*.csv")):
            break
        time.sleep(0.1)
    text = [p.read_text() for p in saved.glob("*.csv")]
    shutil.rmtree(saved, ignore_errors=True)
    check("the button saves the points as front.csv", text == [(report / "front.csv").read_text()], len(text))


def check_low_order(browser, report, entry):
    """The low-order terms before and after, as summary.json has them."""
    run, name = browser.js(f"[planish.RUNS.indexOf(planish.ENTRIES[{entry}].run), planish.ENTRIES[{entry}].method.name]")
    summary = runs_of(report)[run]
    wanted = [summary["initial"]["low_order"], summary["methods"][name]["low_order"]]
    rows = browser.js("[...document.querySelectorAll('#low-order tr')].slice(1).map((r) => [...r.cells].map((c) => c.textContent))")
    near = lambda text, v: abs(float(text) - v) <= 0.5000001e-4
    same = len(rows) == 15 and all(row[0].startswith(b["name"]) and near(row[1], b["coefficient_nm"]) and near(row[2], a["coefficient_nm"])
                                   for row, b, a in zip(rows, wanted[0]["terms"], wanted[1]["terms"]))
    check("the low-order terms before and after are those of summary.json", same, rows[:2])
    check("with what no term has", near(rows[-1][1], wanted[0]["rest_rms_nm"]) and near(rows[-1][2], wanted[1]["rest_rms_nm"]), rows[-1])


def check_tool(browser, report):
    """A tool that is the same everywhere: its map, its sections and its numbers."""
    tool = json.loads((report / "summary.json").read_text())["tool"]
    text = browser.js("document.getElementById('tool').textContent")
    four = lambda v: f"{v:.4g}"
    wanted = ["FWHM x {} mm, y {} mm".format(*map(four, tool["half_maximum_width_mm"])), f"peak {four(tool['peak_nm_per_s'])} nm/s"]
    check("the sections of the tool have its widths and its peak", all(w in text for w in wanted), wanted)
    wide = browser.js("[...document.querySelectorAll('#tool svg')].map((e) => e.getBoundingClientRect().width)")
    check("map and sections are drawn", len(wide) == 2 and min(wide) > 200, wide)


def check_zoom(browser):
    box = panel(browser, "residual")
    cx, cy = box[0] + box[2] / 2, box[1] + box[3] / 2
    before = browser.js("planish.state.view")
    browser.mouse("mouseWheel", cx, cy, deltaX=0, deltaY=0.0)
    browser.click(cx, cy)
    pinned = browser.js("planish.state.pin")
    browser.mouse("mouseWheel", cx, cy, deltaX=0, deltaY=-600)
    browser.settle()
    zoomed = browser.js("planish.state.view")
    check("the wheel zooms a map that was clicked", zoomed[1] - zoomed[0] < 0.6 * (before[1] - before[0]))
    hub = browser.js(f"planish.panels.find((p) => p.name === 'path').box().low")
    mate = browser.js(f"planish.panels.find((p) => p.name === 'residual').box().low")
    check("path and maps show the same part", abs(hub[0] - mate[0]) < 0.2 * (zoomed[1] - zoomed[0]))
    browser.mouse("mouseMoved", cx, cy)
    browser.mouse("mousePressed", cx, cy, button="left", buttons=1, clickCount=1)
    browser.mouse("mouseMoved", cx + 60, cy + 5, button="left", buttons=1)
    browser.mouse("mouseReleased", cx + 60, cy + 5, button="left", clickCount=1)
    browser.settle()
    panned = browser.js("planish.state.view")
    check("dragging moves it", panned[0] < zoomed[0] and abs((panned[1] - panned[0]) - (zoomed[1] - zoomed[0])) < 1e-9)
    check("dragging does not pin", browser.js("planish.state.pin") == pinned)
    browser.click(cx, cy, count=2)
    check("a double click shows all", browser.js("planish.state.view") == before)


def check_profiles(browser, run, entry):
    ink = browser.js("(() => { const c = document.getElementById('profile-x'), d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data, s = new Set(); for (let i = 0; i < d.length; i += 4) s.add(d[i] << 16 | d[i+1] << 8 | d[i+2]); return s.size; })()")
    check("the profile is drawn", ink > 4, ink)


def check_playback(browser, run, entry):
    method = browser.js(f"planish.ENTRIES[{entry}].method.name")
    frames = run / "methods" / method / "frames"
    browser.js("document.getElementById('time').focus()")
    browser.key("Home")
    browser.settle()
    check("the slider goes to the start by keyboard", browser.js("planish.state.time") == 0)
    if frames.exists():
        check("the start shows the desired removal", "start" in browser.js("planish.panels.find((p) => p.name === 'frame').title.textContent"))
        times, removal = np.load(frames / "time_s.npy"), np.load(frames / "removal_nm.npy")
        x, y = np.load(frames / "x_mm.npy"), np.load(frames / "y_mm.npy")
        sx, sy = np.load(run / "surface/x_mm.npy"), np.load(run / "surface/y_mm.npy")
        height = np.load(run / "surface/height_nm.npy")
        desired = height[np.rint((y - sy[0]) / (sy[1] - sy[0])).astype(int)][:, np.rint((x - sx[0]) / (sx[1] - sx[0])).astype(int)]
        for part in (0.4, 1.0):
            total = browser.js(f"planish.ENTRIES[{entry}].total")
            browser.js(f"(() => {{ const t = document.getElementById('time'); t.value = {round(1000 * part)}; t.dispatchEvent(new Event('input')); }})()")
            browser.settle()
            layer = "planish.panels.find((p) => p.name === 'frame').content().layer"
            i = browser.js(layer + ".index")
            expected = int(np.searchsorted(times, round(1000 * part) / 1000 * total * (1 + 1e-9), side="right")) - 1
            kept = browser.js(f"planish.ENTRIES[{entry}].frames.time")
            step = browser.js(layer + ".step")
            shown = np.array(browser.js(f"[...{layer}.values()].map((v) => Number.isNaN(v) ? 1e99 : v)")).reshape(desired.shape)
            wanted = desired - removal[int(np.argmin(np.abs(times - kept[i])))]
            worst = np.nanmax(np.abs(np.where(np.isnan(wanted), 0, shown - wanted)))
            ok = kept[i] <= times[expected] + 1e-9 and worst <= 0.501 * step
            check(f"the frame at {part:.0%} of the time is the simulated one", ok, f"{worst:.1e} of {step:.1e} nm")
            if part == 1.0:
                check("the end of the slider is the last frame", i == len(kept) - 1, f"{i + 1} of {len(kept)}")
    browser.js("document.getElementById('time').focus()")
    browser.key("Home")
    place = browser.js("(() => { document.getElementById('play').scrollIntoView({block: 'center'}); const r = document.getElementById('play').getBoundingClientRect(); return [r.left + 5, r.top + 5]; })()")
    browser.click(*place)
    time.sleep(0.7)
    running = browser.js("planish.state.time")
    browser.click(*place)
    stopped = browser.js("planish.state.time")
    browser.settle()
    check("play moves the tool, pause stops it", running > 0 and stopped == browser.js("planish.state.time"), f"{running:.2f} s")
    # Linked: the pointer on a chart moves the tool on the path.
    browser.js("document.getElementById('velocity').scrollIntoView({block: 'center'})")
    browser.settle()
    r = browser.js("(() => { const r = document.getElementById('velocity').getBoundingClientRect(); return [r.left, r.top, r.width, r.height]; })()")
    browser.mouse("mouseMoved", r[0] + 0.5 * r[2], r[1] + 0.5 * r[3])
    browser.settle()
    hover = browser.js("planish.state.hoverTime")
    total = browser.js(f"planish.ENTRIES[{entry}].total")
    check("the charts are linked with the path", hover is not None and 0.3 * total < hover < 0.7 * total and f"t {int(hover)}." in read_text(browser, "path"), read_text(browser, "path"))
    browser.click(r[0] + 0.5 * r[2], r[1] + 0.5 * r[3])
    browser.key("+", "+")
    browser.settle()
    view = browser.js("planish.state.timeView")
    check("the charts zoom by keyboard", view[1] - view[0] < 0.8 * total, view)
    browser.key("0", "0")
    browser.settle()


def check_methods(browser, run):
    count = browser.js("planish.ENTRIES.length")
    if count < 2:
        return
    browser.js("document.getElementById('a').focus()")
    browser.js("document.getElementById('a').value = '1'; document.getElementById('a').dispatchEvent(new Event('change'))")
    browser.settle()
    name = browser.js("planish.ENTRIES[1].label")
    check("the method switch changes the maps", name in browser.js("planish.panels.find((p) => p.name === 'residual').title.textContent"))
    check("no difference is shown for one method", browser.js("planish.panels.find((p) => p.name === 'difference').figure.hidden"))
    browser.js("document.getElementById('b').value = '0'; document.getElementById('b').dispatchEvent(new Event('change'))")
    browser.settle()
    layer = "planish.panels.find((p) => p.name === 'difference').content().layer"
    every, step = browser.js(f"[{layer}.every, {layer}.step]")
    shown = np.array(browser.js(f"[...{layer}.values()].map((v) => Number.isNaN(v) ? 1e99 : v)"))
    methods = [browser.js(f"planish.ENTRIES[{i}].method.name") for i in (1, 0)]
    a, b = (np.load(run / "methods" / m / "removal" / "residual_nm.npy") for m in methods)
    if every == 1:
        wanted = (a - b).ravel()
        worst = np.nanmax(np.abs(np.where(np.isnan(wanted), 0, shown - wanted)))
        check("the difference map is the difference of the arrays", worst <= 0.501 * step, f"{worst:.1e} of {step:.1e} nm")
        browser.js("(() => { const s = document.getElementById('scale'); for (const v of ['own99', 'own', 'own99']) { s.value = v; s.dispatchEvent(new Event('change')); } })()")
        browser.settle()
        reach = browser.js("planish.panels.find((p) => p.name === 'difference').content().bar.range[1]")
        expected = np.nanquantile(np.abs(wanted - np.nanmean(wanted)), 0.99)
        check("its own scale holds 99 % of it", abs(reach / expected - 1) < 0.02, f"{reach:.4f} nm")
        browser.js("(() => { const s = document.getElementById('scale'); s.value = 'apart'; s.dispatchEvent(new Event('change')); })()")
    check("both residuals are shown", not browser.js("planish.panels.find((p) => p.name === 'residual-b').figure.hidden"))


def check_keyboard(browser):
    """Tab reaches everything that can be used."""
    browser.js("document.activeElement.blur(); scrollTo(0, 0)")
    wanted = set(browser.js("[...document.querySelectorAll('select, button, input, canvas[tabindex], summary')].filter((e) => e.checkVisibility()).map((e, i) => { e.dataset.reach = i; return i; })"))
    reached = set()
    for _ in range(len(wanted) + 20):
        browser.key("Tab")
        at = browser.js("document.activeElement.dataset.reach")
        if at is not None:
            reached.add(int(at))
    check("everything is reached with Tab", wanted <= reached, f"{len(wanted & reached)} of {len(wanted)}")
    panel(browser, "residual")
    browser.js("document.querySelector('[data-panel=\"residual\"]').focus(); planish.state.pointer = null")
    browser.key("ArrowRight")
    browser.settle()
    one = browser.js("planish.state.pointer")
    browser.key("ArrowUp")
    browser.key("ArrowRight")
    browser.settle()
    two = browser.js("planish.state.pointer")
    check("arrows move the pointer", one is not None and two[0] > one[0] and two[1] > one[1])
    browser.key("Enter")
    browser.settle()
    check("Enter pins the profiles", browser.js("planish.state.pin") == two)
    before = browser.js("planish.state.view")
    browser.key("+", "+")
    browser.settle()
    check("+ zooms", browser.js("planish.state.view[1] - planish.state.view[0]") < before[1] - before[0])
    browser.key("0", "0")
    browser.settle()
    check("the focus can be seen", browser.js("getComputedStyle(document.activeElement).outlineStyle") != "none")


def check_look(browser, shots):
    """Widths and colour schemes: nothing sticks out, text can be told from the ground."""
    luminance = "(c) => { const v = c.match(/[\\d.]+/g).slice(0, 3).map((u) => u / 255).map((u) => u <= 0.03928 ? u / 12.92 : ((u + 0.055) / 1.055) ** 2.4); return 0.2126 * v[0] + 0.7152 * v[1] + 0.0722 * v[2]; }"
    for width in (1280, 500, 390):
        for dark in (False, True):
            name = f"{width}-{'dark' if dark else 'light'}"
            browser.size(width, 900, dark)
            browser.js("scrollTo(0, 0)")
            browser.settle()
            over = browser.js("document.documentElement.scrollWidth - innerWidth")
            check(f"{name}: nothing is wider than the window", over <= 0, over)
            cut = browser.js("[...document.querySelectorAll('.scroll')].filter((e) => e.offsetParent).filter((e) => (e.scrollWidth - e.clientWidth > 1) === e.querySelector('.more').hidden).length")
            check(f"{name}: every table that goes on beyond its place says so", cut == 0, cut)
            wide = browser.js("(() => { const e = document.getElementById('summary'); return [e.offsetWidth, e.parentNode.clientWidth, e.tHead.rows[0].cells.length]; })()")
            check(f"{name}: up to six methods are seen at once", width < 1280 or wide[2] > 7 or wide[0] <= wide[1], wide)
            ratios = browser.js(f"(() => {{ const l = {luminance}, ground = l(getComputedStyle(document.body).backgroundColor); return ['body', '.note', '.read', 'td', 'select'].map((s) => document.querySelector(s)).filter(Boolean).map((e) => {{ const t = l(getComputedStyle(e).color); return (Math.max(t, ground) + 0.05) / (Math.min(t, ground) + 0.05); }}); }})()")
            check(f"{name}: contrast of at least 4.5", min(ratios) >= 4.5, f"{min(ratios):.1f}")
            smallest = browser.js("Math.min(...[...document.querySelectorAll('p, td, th, label, .read, li, button')].filter((e) => e.offsetParent).map((e) => parseFloat(getComputedStyle(e).fontSize)))")
            check(f"{name}: text of at least 12 px", smallest >= 12, smallest)
            narrow = browser.js("Math.min(...[...document.querySelectorAll('canvas')].filter((e) => e.checkVisibility()).map((e) => e.clientWidth))")
            check(f"{name}: drawings are wide enough", narrow >= min(360, width - 40), narrow)
            blank = browser.js("[...document.querySelectorAll('canvas')].filter((e) => e.checkVisibility()).filter((c) => { const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data, s = new Set(); for (let i = 0; i < d.length; i += 4) s.add(d[i] << 16 | d[i+1] << 8 | d[i+2]); return s.size < 5; }).map((c) => c.dataset.panel || c.id)")
            check(f"{name}: no drawing is blank", blank == [], blank)
            first = browser.js("(() => { const a = document.querySelector('#answer .sentence').getBoundingClientRect(), c = document.querySelector('#summary thead th:nth-child(2)').getBoundingClientRect(); return [a.bottom, c.left, innerWidth]; })()")
            check(f"{name}: the answer is seen at once, and the column of its plan", first[0] < 450 and first[1] + 60 < first[2], first)
            if shots:
                browser.shot(shots / f"{name}.png", whole=True)


def check_first_screen(browser, report, shots, name):
    """The sentence, and the maps before and after with their numbers, are seen without scrolling, on a screen and a phone."""
    summary = json.loads((report / "summary.json").read_text())
    runs = summary.get("runs", [summary])
    winner = summary.get("winner") or {"sentence": runs[0]["answer"]["sentence"], "method": runs[0]["best"]}
    for width, height in ((1280, 900), (390, 844)):
        for dark in (False, True):
            at = f"{name}, {width} x {height}, {'dark' if dark else 'light'}"
            browser.size(width, height, dark)
            browser.js("scrollTo(0, 0)")
            browser.settle()
            boxes = browser.js("['#answer .sentence', '[data-panel=desired]', '[data-panel=residual]'].map((s) => document.querySelector(s).getBoundingClientRect()).map((r) => [r.left, r.top, r.right, r.bottom])")
            inside = all(0 <= left < right <= width and 0 <= top < bottom <= height for left, top, right, bottom in boxes)
            check(f"{at}: the sentence and both maps are on the first screen", inside, boxes)
            check(f"{at}: the sentence is the answer", browser.js("document.querySelector('#answer .sentence').textContent") == winner["sentence"])
            entry = browser.js("[planish.ENTRIES[planish.state.a].run.name, planish.ENTRIES[planish.state.a].method.name]")
            check(f"{at}: the map after is of the plan to be run", entry[1] == winner["method"] and winner.get("run") in (None, entry[0]), entry)
            # The same number of pixels for a mm along x and y, in both maps, and at least 100 pixels of the longer side.
            scales = browser.js("['desired', 'residual'].map((n) => planish.panels.find((p) => p.name === n).box()).map((b) => [b.x.at(1) - b.x.at(0), b.y.at(0) - b.y.at(1)])")
            extent = browser.js("(() => { const l = planish.ENTRIES[planish.state.a].residual; return Math.max(l.nx * l.dx, l.ny * l.dy); })()")
            equal = max(sum(scales, [])) - min(sum(scales, [])) < 1e-9 * scales[0][0]
            check(f"{at}: both on the same true scale", equal and scales[0][0] * extent >= 100, [scales, extent])
            captions = browser.js("['desired', 'residual'].map((n) => planish.panels.find((p) => p.name === n).title.textContent)")
            run = next(r for r in runs if r["best"] == entry[1] and (len(runs) == 1 or r["answer"]["sentence"] == browser.js("planish.ENTRIES[planish.state.a].run.summary.answer.sentence")))
            method = run["methods"][entry[1]]
            read = [[float(v) for v in re.findall(NUMBER + " nm (?:RMS|PV)", text)] for text in captions]
            wanted = [[run["initial"]["rms_nm"], run["initial"]["pv_nm"]], [method["rms_nm"], method["pv_nm"]]]
            # Four digits are shown.
            near = np.shape(read) == (2, 2) and np.allclose(read, wanted, rtol=5.01e-4)
            time_read = re.search(rf", {NUMBER} (s|min|h): ", captions[1])
            time_s = float(time_read[1]) * {"s": 1, "min": 60, "h": 3600}[time_read[2]]
            whole_s = run["several"]["total_time_s"] if "several" in run else method["total_time_s"]
            check(f"{at}: with RMS, PV and time of summary.json", near and abs(time_s / whole_s - 1) < 5.01e-3, captions)
            check(f"{at}: nothing is wider than the window", browser.js("document.documentElement.scrollWidth - innerWidth") <= 0)
            if shots:
                browser.shot(shots / f"first-{name}-{width}-{'dark' if dark else 'light'}.png")


def check_everywhere(browser, report):
    """The same numbers at both widths, in both colour schemes, with the slider at both ends."""
    for width in (1280, 390):
        for dark in (False, True):
            browser.size(width, 900, dark)
            for end in (0, 1000):
                browser.js(f"(() => {{ const t = document.getElementById('time'); t.value = {end}; t.dispatchEvent(new Event('input')); }})()")
                browser.settle()
                print(f"{width} px, {'dark' if dark else 'light'}, slider at {end / 10:.0f} %")
                check_answer(browser, report)
                check_table(browser, report)
                entry = browser.js("planish.state.a")
                shown = float(browser.js("document.getElementById('now').textContent").split(" ")[0])
                total = browser.js(f"planish.ENTRIES[{entry}].total")
                check("the slider says the time at its end", abs(shown - end / 1000 * total) < 0.006, shown)


def ordinary(report, run, shots):
    browser = Browser()
    try:
        browser.size(1280, 900)
        browser.open(report / "report.html")
        size = (report / "report.html").stat().st_size
        check("the page is at most 10 MB", size <= 10e6, f"{size / 1e6:.2f} MB")
        entry = browser.js("planish.state.a")
        check_first_screen(browser, report, shots, "one")
        browser.size(1280, 900)
        check_answer(browser, report)
        check_table(browser, report)
        check_places(browser, report, run)
        check_pointer(browser, run, entry)
        check_slopes(browser, report, run, entry)
        check_hand(browser)
        check_front(browser, report)
        check_low_order(browser, report, entry)
        check_tool(browser, report)
        check_zoom(browser)
        check_profiles(browser, run, entry)
        check_playback(browser, run, entry)
        check_keyboard(browser)
        check_methods(browser, run)
        check_look(browser, shots)
        check_everywhere(browser, report)
        check("no error in the console, no request to a network", browser.complaints() == [], browser.complaints()[:3] or "")
    finally:
        browser.close()


def tools(run, shots):
    """A run of several tools: the first screen, the tools in their order, their maps, and the subsets of the rack."""
    report = run / "report"
    summary = json.loads((report / "summary.json").read_text())
    several = summary["several"]
    browser = Browser()
    try:
        browser.size(1280, 900)
        browser.open(report / "report.html")
        check_first_screen(browser, report, shots, "tools")
        browser.size(1280, 900)
        names = [t["name"] for t in several["tools"]]
        rows = browser.js("[...document.querySelectorAll('#several-tools tr')].slice(1).map((r) => [...r.cells].map((c) => c.textContent))")
        check("the tools stand in the order in which they run", [row[0] for row in rows] == names, names)
        near = all(abs(float(row[5]) - t["rms_nm"]) <= 0.5000001e-4 and abs(float(row[8]) - t["elapsed_s"]) <= 0.5000001e-2 for row, t in zip(rows, several["tools"]))
        check("with what they leave and when they are ready", near, rows[-1])
        links = browser.js("[...document.querySelectorAll('#several-section a, #several-subsets a')].map((a) => a.getAttribute('href'))")
        check("every link leads to a file", all((report / link).is_file() for link in links), links)
        drawn = browser.js("planish.panels.filter((p) => !p.figure.hidden).map((p) => p.name)")
        check("each tool has the map of its removal", all(f"removal-{i}" in drawn for i in range(len(names))), drawn)
        check("and all but the last the map after it", all(f"after-{i}" in drawn for i in range(len(names) - 1)), drawn)
        for i, name in enumerate(names):
            place = run / "tools" / name
            place = place / "program" if (place / "program" / "removal").exists() else place
            removal = np.load(place / "removal/removal_nm.npy")
            height = np.load(run / "surface/height_nm.npy")
            layer = f"planish.panels.find((p) => p.name === 'removal-{i}').content().layer"
            every, step = browser.js(f"[{layer}.every, {layer}.step]")
            if every == 1:
                shown = np.array(browser.js(f"[...{layer}.values()].map((v) => Number.isNaN(v) ? 1e99 : v)")).reshape(height.shape)
                worst = np.abs(shown - removal).max()
                check(f"{name}: the removal is that of its motion", worst <= 0.501 * step, f"{worst:.1e} of {step:.1e} nm")
        points = browser.js("planish.DATA.front.points")
        chosen = [p for p in points if p["is_recommended"]]
        wanted = len(several["subsets"]) + len(several["others"]) + 1
        check("every subset, every other plan and the plan are points", len(points) == wanted and len(chosen) == 1, len(points))
        check("the plan has its time with changes", abs(chosen[0]["time_s"] - several["total_time_s"]) < 1e-9, chosen[0]["plan"])
        for i in range(len(names)):
            browser.js(f"(() => {{ const s = document.getElementById('a'); s.value = {i}; s.dispatchEvent(new Event('change')); }})()")
            browser.settle()
            check_low_order(browser, report, i)
        warned = browser.js("[...document.querySelectorAll('.warning')].map((e) => e.textContent)")
        check("the warnings stand below the answer", warned == several["warnings"], len(warned))
        check_look(browser, None)
        if shots:
            for width in (1280, 390):
                for dark in (False, True):
                    browser.size(width, 900, dark)
                    browser.settle()
                    browser.shot(shots / f"tools-{width}-{'dark' if dark else 'light'}.png", whole=True)
        check("no error in the console, no request to a network", browser.complaints() == [], browser.complaints()[:3] or "")
    finally:
        browser.close()


def docs(report, shots):
    """The pictures of docs/report.md."""
    browser = Browser()
    try:
        browser.size(1280, 860)
        browser.open(report / "report.html")
        browser.shot(shots / "summary.png")
        browser.size(1280, 1060)
        browser.js("(() => { for (const [id, value] of [['b', 1], ['scale', 'own99']]) { const s = document.getElementById(id); s.value = value; s.dispatchEvent(new Event('change')); } })()")
        browser.js("planish.state.pin = [26.0, 12.0]; document.getElementById('maps').scrollIntoView({block: 'start'}); scrollBy(0, -60)")
        browser.settle()
        browser.shot(shots / "maps.png")
        browser.size(1280, 860)
        browser.js("(() => { for (const [id, value] of [['b', -1], ['scale', 'apart']]) { const s = document.getElementById(id); s.value = value; s.dispatchEvent(new Event('change')); } })()")
        browser.js("(() => { const t = document.getElementById('time'); t.value = 450; t.dispatchEvent(new Event('input')); })()")
        browser.js("document.getElementById('time').scrollIntoView({block: 'start'}); scrollBy(0, -60)")
        browser.settle()
        browser.shot(shots / "motion.png")
    finally:
        browser.close()


def several(report, shots):
    """A report of several runs: one table, and maps of different runs beside each other."""
    browser = Browser()
    try:
        browser.size(1280, 900)
        browser.open(report / "report.html")
        check_first_screen(browser, report, shots, "several")
        browser.size(1280, 900)
        check_answer(browser, report)
        check_table(browser, report)
        browser.js("(() => { const s = document.getElementById('b'), a = planish.ENTRIES[planish.state.a]; s.value = planish.ENTRIES.findIndex((e) => e.run !== a.run && e.method.name === 'pvt'); s.dispatchEvent(new Event('change')); })()")
        browser.settle()
        runs = browser.js("[planish.ENTRIES[planish.state.a].run.name, planish.ENTRIES[planish.state.b].run.name]")
        check("methods of two runs are beside each other", runs[0] != runs[1], runs)
        shown = browser.js("planish.panels.filter((p) => !p.figure.hidden).map((p) => p.name)")
        check("with their difference", "difference" in shown and "residual-b" in shown)
        pair = browser.js("(() => { const l = planish.panels.find((p) => p.name === 'difference').content().layer, a = planish.ENTRIES[planish.state.a].residual, b = planish.ENTRIES[planish.state.b].residual, i = Math.floor(l.nx * l.ny * 0.4), x = l.x0 + (i % l.nx) * l.dx, y = l.y0 + Math.floor(i / l.nx) * l.dy; return [l.values()[i], planish.valueAt(a, x, y).value - planish.valueAt(b, x, y).value]; })()")
        check("pixel by pixel", abs(pair[0] - pair[1]) < 1e-12, pair)
        if shots:
            browser.shot(shots / "several.png", whole=True)
        check("no error in the console, no request to a network", browser.complaints() == [], browser.complaints()[:3] or "")
    finally:
        browser.close()


def pan(browser, cx, cy):
    """Longest task, ms, and time, s, of thirty moves with the button held from a place of the page."""
    browser.js("window.longest = 0")
    began = time.time()
    browser.mouse("mousePressed", cx, cy, button="left", buttons=1, clickCount=1)
    for i in range(30):
        browser.mouse("mouseMoved", cx + 4 * i, cy + 2 * i, button="left", buttons=1)
    browser.mouse("mouseReleased", cx + 120, cy + 60, button="left", clickCount=1)
    seconds = time.time() - began
    browser.settle()
    return browser.js("window.longest"), seconds


def large(programs, work):
    """1641 x 1641 pixels, 500 lines of 500 segments: opens and pans without a freeze."""
    shutil.rmtree(work, ignore_errors=True)
    n, lines, per_line = 1641, 500, 500
    axis = np.linspace(0, 164.0, n)
    x, y = np.meshgrid(axis, axis)
    height = 20 + 8 * np.sin(x / 11) * np.cos(y / 17) + 0.5 * np.sin(3 * x)
    height[(x - 82) ** 2 + (y - 82) ** 2 > 82**2] = np.nan
    removal = np.where(np.isnan(height), 10.0, height - 0.3 * np.sin(2 * x + y))
    removal = np.maximum(removal, 0)
    run = work / "run"

    def save(where, **arrays):
        where.mkdir(parents=True, exist_ok=True)
        for name, array in arrays.items():
            np.save(where / (name + ".npy"), np.ascontiguousarray(array))

    save(run / "surface", height_nm=height, x_mm=axis, y_mm=axis)
    save(run / "methods/pvt/removal", removal_nm=removal, residual_nm=height - removal, x_mm=axis, y_mm=axis)
    points = []
    for i, level in enumerate(np.linspace(0, 164, lines)):
        along = np.linspace(0, 164, per_line + 1)[1:]
        along = along if i % 2 == 0 else 164 - along
        points.append(np.stack([along, np.full(per_line, level)], axis=1))
    point = np.concatenate([[[0.0, 0.0]]] + points)
    seconds = 0.02 + 0.015 * np.sin(np.arange(len(point) - 1) / 40)
    coefficient = np.zeros((len(seconds), 2, 4))
    coefficient[:, :, 0] = point[:-1]
    coefficient[:, :, 1] = np.diff(point, axis=0) / seconds[:, None]
    save(run / "methods/pvt/trajectory", break_time_s=np.concatenate([[0], np.cumsum(seconds)]), coefficient_mm=coefficient,
         tool_on=np.ones(len(seconds), np.uint8), dwell_index=np.arange(len(seconds)))
    save(run / "tool_path", point_mm=point, dwell_point_mm=0.5 * (point[1:] + point[:-1]))
    save(run / "dwell", dwell_s=seconds * 1.01)
    machine = work / "machine.json"
    limit = {"max_velocity_mm_per_s": 250, "max_acceleration_mm_per_s2": 2000}
    machine.write_text(json.dumps({"name": "large", "axes": [{"name": a, **limit} for a in "xy"]}))
    subprocess.run([programs / "planish-verify", "--trajectory", run / "methods/pvt/trajectory", "--machine", machine,
                    "--out", run / "methods/pvt/verdict"], check=False, capture_output=True)
    began = time.time()
    made = subprocess.run([programs / "planish-compare", "report", run, "--out", work / "report"], capture_output=True, text=True)
    # The motion of this mirror exceeds the limits on purpose: negative, and made all the same.
    check("the report is made", made.returncode == 1, made.stderr[-300:] if made.returncode != 1 else f"{time.time() - began:.1f} s")
    page = work / "report/report.html"
    check("the page is at most 10 MB", page.stat().st_size <= 10e6, f"{page.stat().st_size / 1e6:.2f} MB")
    browser = Browser()
    try:
        browser.size(1280, 900)
        began = time.time()
        browser.open(page)
        check("it opens", browser.js("planish.ENTRIES.length") == 1, f"{time.time() - began:.1f} s")
        browser.js("window.longest = 0; new PerformanceObserver((l) => l.getEntries().forEach((e) => { window.longest = Math.max(window.longest, e.duration); })).observe({entryTypes: ['longtask']})")
        for name in ("residual", "path"):
            box = panel(browser, name)
            cx, cy = box[0] + box[2] / 2, box[1] + box[3] / 2
            browser.click(cx, cy)
            browser.mouse("mouseWheel", cx, cy, deltaX=0, deltaY=-400)
            browser.settle()
            # Half a second is a freeze. On a shared machine a frame may wait for its turn, so the best of three counts.
            panned = [pan(browser, cx, cy) for _ in range(3)]
            longest, seconds = min(panned)
            check(f"{name}: pans without a freeze", longest < 500, f"30 moves in {seconds:.2f} s, longest task {longest:.0f} ms")
        stated = browser.js("document.getElementById('contents').textContent")
        check("what is left out is stated", "means over" in stated and "together" in stated)
        check("full values can be loaded", full_values(browser, run, height), browser.js("document.getElementById('loaded').textContent"))
        check("no error in the console, no request to a network", browser.complaints() == [], browser.complaints()[:3] or "")
        browser.js("scrollTo(0, 0)")
        browser.settle()
        browser.shot(work / "large.png", whole=True)
    finally:
        browser.close()


def hostile(programs, run):
    """Names, settings and manifests that are programs: nothing of them runs, and the page works."""
    work = pathlib.Path(tempfile.mkdtemp(prefix="planish-hostile-"))
    name = "{{data}}<img src=x onerror=window.hit=1>\u001b[31m&quot;"
    copy = work / name
    shutil.copytree(run, copy, ignore=shutil.ignore_patterns("report", "fixture"))
    program = "</script><script>window.hit=2</script><svg onload=window.hit=3>"
    for manifest in copy.rglob("manifest.json"):
        data = json.loads(manifest.read_text())
        if data["kind"] == "verdict":
            continue  # its outcome is nowhere else, so its manifest is sealed, and a changed one is refused
        data["command"] = data["tool_version"] = data["method"] = program
        data["settings"] = {program: [program, "\u2028"]}
        manifest.write_text(json.dumps(data))
    (copy / "methods/pvt").rename(copy / "methods/pvt<svg onload=window.hit=4>\u0007")
    made = subprocess.run([programs.resolve() / "planish-compare", "report", copy, "--out", work / "report", "--mirror", program,
                           "--pipeline", "<!--<script>"], capture_output=True, text=True)
    check("the report is made", made.returncode == 0, made.stderr[-300:])
    check("no command reaches the terminal", not any(ord(c) < 32 and c != "\n" for c in made.stdout + made.stderr))
    browser = Browser()
    try:
        browser.size(1280, 900)
        browser.open(work / "report/report.html")
        check("no program in a name has run", browser.js("window.hit === undefined"))
        check("the names are shown as they are", program[:20] in browser.js("document.getElementById('names').textContent"))
        check("so are the manifests", browser.js("document.getElementById('provenance').textContent").count(program) > 3)
        check("there is no other element", browser.js("document.querySelectorAll('img, svg, iframe').length") == 0)
        check_table(browser, work / "report")
        check_playback(browser, copy, browser.js("planish.state.a"))
        browser.js("(() => { const s = document.getElementById('b'); s.value = 0; s.dispatchEvent(new Event('change')); })()")
        browser.settle()
        check("another method can be chosen", not browser.js("planish.panels.find((p) => p.name === 'difference').figure.hidden"))
        browser.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(work / "saved"))
        browser.js("document.querySelector('figcaption button').click()")
        for _ in range(100):
            if list((work / "saved").glob("*.png")):
                break
            time.sleep(0.1)
        saved = list((work / "saved").glob("*.png"))
        check("a drawing is saved as PNG", len(saved) == 1 and saved[0].read_bytes()[:4] == b"\x89PNG", [p.name for p in saved])
        check("no error in the console, no request to a network", browser.complaints() == [], browser.complaints()[:3] or "")
        # The second wall: what did get into the page would not run either.
        browser.js("document.body.insertAdjacentHTML('beforeend', '<img src=x onerror=window.hit=5><a href=javascript:window.hit=6 id=bait>x</a>')")
        browser.js("(() => { const s = document.createElement('script'); s.textContent = 'window.hit=7'; document.body.append(s); document.getElementById('bait').click(); })()")
        browser.settle()
        check("the policy lets nothing run that is not the page's own", browser.js("window.hit === undefined"), browser.js("window.hit"))
        refused = [text for text in browser.complaints() if "Content Security Policy" in text]
        check("and says so", len(refused) >= 2, len(refused))
        # Every method left out: the page says why and draws nothing.
        for method in (copy / "methods").iterdir():
            if method.name != "position":
                shutil.rmtree(method)
        shutil.rmtree(copy / "methods/position/verdict")
        shutil.copytree(run / "methods/pvt/verdict", copy / "methods/position/verdict")
        made = subprocess.run([programs.resolve() / "planish-compare", "report", copy, "--out", work / "none"], capture_output=True, text=True)
        check("a report of nothing valid is negative", made.returncode == 1, made.stderr[-300:])
        browser.events.clear()
        browser.call("Page.navigate", url=(work / "none/report.html").resolve().as_uri())
        browser.settle()
        check("its page says why", "not valid: its verdict is of another trajectory" in browser.js("document.getElementById('notes').textContent"))
        check("without an error", browser.complaints() == [] and browser.js("document.querySelectorAll('section:not([hidden])').length") == 4, browser.complaints()[:3] or "")
        answer = browser.js("document.getElementById('answer').textContent")
        check("and says at the top that nothing is to be run", answer.startswith("Nothing here is to be run."), answer)
        for svg in sorted((work / "report").glob("*.svg")):
            browser.call("Page.navigate", url=svg.resolve().as_uri())
            browser.settle()
            broken = browser.js("document.documentElement.nodeName !== 'svg' || !!document.querySelector('parsererror') || window.hit !== undefined")
            check(f"{svg.name} is a drawing", not broken)
    finally:
        browser.close()
        shutil.rmtree(work, ignore_errors=True)


def full_values(browser, run, height):
    root = browser.call("DOM.getDocument")["root"]["nodeId"]
    node = browser.call("DOM.querySelector", nodeId=root, selector="#npy")["nodeId"]
    browser.call("DOM.setFileInputFiles", nodeId=node, files=[str((run / "surface/height_nm.npy").resolve())])
    browser.js("new Promise((r) => setTimeout(r, 1500))")
    at = browser.js("planish.valueAt(planish.ENTRIES[0].run.desired, 82.0, 82.0)")
    return at["row"] == 820 and at["value"] == height[820, 820]


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("first", type=pathlib.Path)
    parser.add_argument("second", type=pathlib.Path, nargs="?")
    parser.add_argument("--shots", type=pathlib.Path)
    parser.add_argument("--large", action="store_true")
    parser.add_argument("--docs", action="store_true")
    parser.add_argument("--hostile", action="store_true")
    parser.add_argument("--several", action="store_true")
    parser.add_argument("--tools", action="store_true")
    arguments = parser.parse_args()
    if arguments.large:
        large(arguments.first, arguments.second)
    elif arguments.hostile:
        hostile(arguments.first, arguments.second)
    elif arguments.several:
        several(arguments.first, arguments.shots)
    elif arguments.tools:
        tools(arguments.first, arguments.shots)
    elif arguments.docs:
        docs(arguments.first, arguments.second)
    else:
        ordinary(arguments.first, arguments.second, arguments.shots)
    print(f"{len(FAILED)} failed" if FAILED else "all passed")
    sys.exit(1 if FAILED else 0)


if __name__ == "__main__":
    main()
