"""Plans in the page of `planish app` in headless Chromium, as a person would, from a file to a program.

    browser.py PLANISH_BIN_DIR WORK_DIR [--shots DIR] [--file MAP ...]
    browser.py PLANISH_BIN_DIR WORK_DIR --docs PICTURE     the picture of docs/app.md

Every --file is a map of an instrument that is read, too, with what it does not state: --file "map.mat unit=m". Needs chromium (Debian package), numpy, h5py and websocket-client.
Exit code 1 when a check fails.
"""

import argparse
import os
import pathlib
import shutil
import subprocess
import sys
import time

import numpy as np

for other in ("compare/tests", "import/tests"):
    sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[2] / other))
from chromium import FAILED, Browser, check  # noqa: E402
from writers import WAVELENGTH, write_datx, write_four_sight, write_mat  # noqa: E402

SHARE = pathlib.Path(__file__).resolve().parents[3]
# Widths of the pictures, px, and whether they are dark.
SCREENS = [(1280, 900, False), (1280, 900, True), (800, 900, False), (390, 844, False), (390, 844, True), (2560, 1300, False)]


class App:
    """A server, and its address."""

    def __init__(self, programs, session):
        environment = {**os.environ, "PLANISH_SHARE": str(SHARE)}
        self.process = subprocess.Popen([programs / "planish", "app", session, "--no-browser"], stdout=subprocess.PIPE, text=True, env=environment)
        self.address = self.process.stdout.readline().split(": ", 1)[1].strip()

    def kill(self):
        self.process.kill()
        self.process.wait()


def visit(browser, address):
    browser.call("Page.navigate", url=address)
    wait(browser, "!!window.planish && !!planish.state", 20)


def wait(browser, condition, seconds=120):
    begun = time.time()
    while time.time() - begun < seconds:
        if browser.js(condition):
            browser.settle()
            return time.time() - begun
        time.sleep(0.05)
    check(f"comes: {condition}", False, browser.js("document.getElementById('error').textContent"))
    return None


def idle(browser, step):
    wait(browser, f"!planish.state.running && planish.state.session.{step} && planish.state.session.{step}.end !== 'running'")
    return browser.js(f"planish.state.session.{step}.end")


def put(browser, field, value):
    browser.js(f"(() => {{ const f = document.getElementById('{field}'); f.value = {value!r}; f.dispatchEvent(new Event('change')); }})()")


def press(browser, form):
    browser.js(f"document.querySelector('#{form} button[type=submit]').click()")


def give(browser, field, *files):
    root = browser.call("DOM.getDocument")["root"]["nodeId"]
    node = browser.call("DOM.querySelector", nodeId=root, selector=f"#{field}")["nodeId"]
    browser.call("DOM.setFileInputFiles", nodeId=node, files=[str(pathlib.Path(f).resolve()) for f in files])


def error(browser):
    return browser.js("document.getElementById('error').hidden ? '' : document.getElementById('error').textContent")


def check_demo(browser, shots):
    browser.js("document.getElementById('demo').click()")
    wait(browser, "planish.state.running || planish.state.has_report", 10)
    check("the demonstration plans", idle(browser, "plan") in ("done", "negative"))
    wait(browser, "!!document.querySelector('iframe')", 20)
    check("the answer is a sentence", " runs on " in browser.js("document.getElementById('sentence').textContent"))
    check("every step shows its command", browser.js("document.querySelectorAll('pre.command').length") == 3)
    put(browser, "controller", "galil")
    press(browser, "program-form")
    time.sleep(0.5)
    check("a program is written", idle(browser, "plan") in ("done", "negative") and browser.js("planish.state.program") == "program.galil")
    wait(browser, "!document.getElementById('download').hidden", 10)
    size = browser.js("fetch('program').then((a) => a.text()).then((t) => t.length)")
    check("and can be saved", size > 1000, size)
    wait(browser, "planish.estimates.raster && !!planish.estimates.raster.answer", 30)
    # A sixth of 7 mm is 1.167 mm; the ripple of this Gaussian of 1 mm is 0.1 % at 1.54 mm.
    proposal = browser.js("document.getElementById('proposal-pitch_mm').textContent")
    check("the pitch is proposed by the tool, and not above its limit", "1.1 mm" in proposal, proposal)
    check("its verdict is shown", "program" in browser.js("document.getElementById('program-verdict').textContent"))


def shots(browser, folder):
    """Looks at the page on every screen, and saves it."""
    for width, height, dark in SCREENS:
        browser.size(width, height, dark)
        browser.settle()
        wide = browser.js("document.documentElement.scrollWidth")
        check(f"nothing is wider than {width} px", wide <= width, wide)
        if folder:
            browser.shot(folder / f"demo-{width}{'-dark' if dark else ''}.png", whole=True)
    browser.size(1280, 900)


def check_estimates(browser):
    """Estimates, the slider, and the kinds of paths."""
    wait(browser, "document.getElementById('estimate').textContent.startsWith('Estimate: ')", 30)
    print(f"     an estimate takes {browser.js('planish.estimates.raster.answer.took_s'):.2f} s, seen after {browser.js('planish.estimates.raster.answer.seen_s'):.2f} s")
    pitch = "document.querySelector('[data-setting=pitch_mm]')"
    for text in ("0.9", "0.8", "0"):
        browser.js(f"{pitch}.value = '{text}'; {pitch}.dispatchEvent(new Event('change'))")
        time.sleep(0.25)
    wait(browser, "!!document.querySelector('#plan-form .refused:not(:empty)')", 20)
    check("a refusal stands beside its field", "pitch_mm is '0'" in browser.js(f"{pitch}.closest('label').querySelector('.refused').textContent"))
    browser.js(f"{pitch}.value = ''; {pitch}.dispatchEvent(new Event('change'))")
    wait(browser, "document.getElementById('estimate').textContent.startsWith('Estimate: ') && !document.querySelector('#plan-form .refused:not(:empty)')", 30)
    before = browser.js("document.getElementById('estimate').textContent")
    browser.js("(() => { const s = document.getElementById('worth'); s.value = 8; s.dispatchEvent(new Event('input')); })()")
    after = browser.js("document.getElementById('estimate').textContent")
    check("the slider goes along the front", after != before and browser.js("document.querySelector('[data-setting=time_elasticity]').value") == "2", after[:60])
    times = browser.js("[0.1, 0.5, 2].map((e) => pointOf(planish.estimates.raster.answer.points, e).time_s)")
    check("more worth of time is a shorter run", times[0] > times[1] > times[2], times)
    browser.js("document.querySelector('[data-setting=time_elasticity]').value = ''; showEstimates()")
    browser.js("document.getElementById('compare-paths').click()")
    wait(browser, "planish.state.pipelines.every((name) => planish.estimates[name])", 60)
    browser.settle()
    drawn = browser.js("[...document.querySelectorAll('.card img')].filter((i) => !i.hidden && i.naturalWidth > 0).length")
    check("kinds of paths are drawn side by side", drawn >= 4, f"{drawn} of 5")
    texts = browser.js("[...document.querySelectorAll('.card .numbers')].filter((n) => n.textContent).length")
    check("each with its numbers or its refusal", texts == 5, texts)


def check_result(browser):
    """Maps of the result: one point for all, zoom, and a drawing as SVG."""
    wait(browser, "!!planish.views.residual && !!planish.views.residual.map", 20)
    browser.js("planish.views.before.canvas.focus()")
    browser.key("ArrowRight")
    browser.settle()
    points = browser.js("['before', 'removal', 'residual'].map((n) => planish.views[n].point.join())")
    check("one point moves in all maps", len(set(points)) == 1, points)
    text = browser.js("document.getElementById('across-values').textContent")
    check("values of all maps at the point", "before the run" in text and "residual" in text, text[:90])
    # At every pixel the map before is removal plus residual.
    rest = browser.js("Math.max(...planish.views.before.map.values.map((v, i) => Math.abs(v - planish.views.removal.map.values[i] - planish.views.residual.map.values[i])))")
    check("the map before is removal plus residual", rest < 1e-4, rest)
    browser.key("+")
    browser.settle()
    width = browser.js("(() => { const v = planish.views.before, e = v.map.edges_mm; return (v.window[1] - v.window[0]) / (e[1] - e[0]); })()")
    check("a map zooms", abs(width - 1 / 1.6) < 1e-9, width)
    browser.key("0")
    svg = browser.js("(() => { const v = planish.views.before, s = new SvgContext(400, 300); v.paint(s); return s.toString(); })()")
    check("a drawing is SVG", svg.startswith("<svg") and "<image" in svg and "NaN" not in svg and "undefined" not in svg, svg[:60])


def check_machine(browser):
    field = "document.querySelector('#machine-limits input')"
    browser.js(f"{field}.value = '120'; {field}.dispatchEvent(new Event('change'))")
    text = browser.js("JSON.parse(document.getElementById('machine-text').value).axes[0].max_velocity_mm_per_s")
    check("a limit with its unit is edited", text == 120, text)
    browser.js(f"{field}.value = '-1'; {field}.dispatchEvent(new Event('change'))")
    press(browser, "machine-form")
    wait(browser, "!document.getElementById('error').hidden", 10)
    check("and checked", "max_velocity_mm_per_s" in error(browser), error(browser)[:80])
    browser.js(f"{field}.value = '250'; {field}.dispatchEvent(new Event('change'))")


def check_aperture(browser):
    before = browser.js("planish.views.part.map.pixels[0]")
    put(browser, "part-aperture", "circle")
    numbers = browser.js("document.getElementById('part-aperture-mm').value").split(" ")
    check("an aperture is proposed by the map", len(numbers) == 3, numbers)
    press(browser, "part-form")
    wait(browser, f"planish.views.part.map.pixels[0] !== {before}", 20)
    pixels, edges = browser.js("planish.views.part.map.pixels"), browser.js("planish.views.part.map.edges_mm")
    check("a circle is as wide as it is high", pixels[0] == pixels[1], pixels)
    check("and has its diameter", abs(edges[1] - edges[0] - 2 * float(numbers[2])) <= 1.0, edges)
    put(browser, "part-aperture", "")
    press(browser, "part-form")
    wait(browser, f"planish.views.part.map.pixels[0] === {before}", 20)


def check_after(browser, programs, work, session):
    """The map after a run with hidden errors leads to the next run."""
    run = session / "runs/raster-coupon"
    subprocess.run([programs / "planish", "simulate", "--trajectory", run / "methods/joint/trajectory", "--tif", run / "fixture/tif", "--surface", run / "surface",
                    "--error-budget", SHARE / "fixtures/error-budgets/hidden.json", "--seed", "7", "--measured-out", work / "after", "--out", work / "truth"],
                   check=True, stdout=subprocess.DEVNULL)
    give(browser, "after-file", *(work / "after" / f"{n}.npy" for n in ("height_nm", "x_mm", "y_mm")))
    wait(browser, "planish.state.session.after && planish.state.session.after.end !== 'running'", 120)
    check("the map after the run is learnt from", browser.js("planish.state.session.after.end") in ("done", "negative"), browser.js("planish.state.messages[3][1].slice(-300)"))
    text = browser.js("document.getElementById('learnt').textContent")
    check("the page says what it taught, and whether to run again", "rate_scale" in text and ("RUN AGAIN" in text or "STOP" in text), text[-120:])
    wait(browser, "!!document.querySelector('#next-report iframe')", 10)


def check_labels(browser):
    bare = browser.js("[...document.querySelectorAll('input, select, textarea')].filter((e) => !e.labels.length && !e.getAttribute('aria-label')).map((e) => e.id)")
    check("every field has a label", bare == [], bare)
    shown = browser.js("[...document.querySelectorAll('#settings label')].filter((l) => !l.querySelector('small').textContent).length")
    check("and every setting a sentence", shown == 0)
    names = browser.js("[...document.querySelectorAll('canvas')].filter((c) => !c.getAttribute('aria-label')).length")
    check("and every drawing a name", names == 0)
    browser.js("planish.views.part.canvas.focus()")
    before = browser.js("planish.views.part.value.textContent")
    browser.key("ArrowRight")
    check("arrow keys move the point", browser.js("planish.views.part.value.textContent") != before)


def check_arrays(browser, work, session):
    """Three arrays, against what the page says of them."""
    rng = np.random.default_rng(68)
    x, y = 0.5 * np.arange(61), 0.5 * np.arange(41)
    z = 20 * np.outer(np.cos(y / 6), np.sin(x / 7)) + rng.normal(0, 0.1, (41, 61))
    z[:3, :5] = np.nan
    for name, array in [("height_nm", z), ("x_mm", x), ("y_mm", y)]:
        np.save(work / f"{name}.npy", array)
    give(browser, "part-file", *(work / f"{n}.npy" for n in ("height_nm", "x_mm", "y_mm")))
    wait(browser, "planish.state.session.part && planish.state.session.part.choice.source === 'arrays'", 20)
    check("three arrays are read", idle(browser, "part") == "done", error(browser))
    wait(browser, "planish.views.part && planish.views.part.map.pixels[0] === 61", 20)
    rms = browser.js("planish.views.part.map.numbers[0][1]")
    check("their RMS is that of numpy", abs(rms - np.nanstd(z)) < 1e-9, rms)
    value = browser.js("planish.views.part.map.values[20 * 61 + 30]")
    lowest = np.nanmin(z)
    check("so is a height", abs(value - (z[20, 30] - lowest)) < 1e-5, value)
    put(browser, "tool-source", "formula")
    put(browser, "tool-peak", "8")
    put(browser, "tool-fwhm", "3")
    press(browser, "tool-form")
    wait(browser, "planish.state.session.tool && !!planish.state.session.tool.choice.source.formula && planish.state.session.tool.end === 'done'", 20)
    wait(browser, "planish.views.tool && Math.abs(planish.views.tool.map.numbers[0][1] - 8) < 1e-9", 20)
    width = browser.js("planish.views.tool.map.numbers[1][1]")
    # Samples at FWHM / 20 and a cut-off at 3.5 sigma.
    check("the formula has its width", abs(width - 3) < 0.03, width)
    put(browser, "machine-fixture", "ion-beam")
    wait(browser, "planish.state.session.machine && planish.state.session.machine.fixture === 'ion-beam' && document.getElementById('machine-text').value.includes('ion-beam')", 10)
    put(browser, "controller", "csv")
    press(browser, "program-form")
    wait(browser, "!document.getElementById('error').hidden", 10)
    check("no program for a machine of the fixtures", "fixtures" in error(browser), error(browser)[:60])
    press(browser, "machine-form")
    wait(browser, "planish.state.session.machine === 'own'", 10)
    for setting, text in [("pitch_mm", "1.5"), ("plan_joint", "no"), ("refine", "no")]:
        browser.js(f"document.querySelector('[data-setting={setting}]').value = '{text}'")
    press(browser, "program-form")
    wait(browser, "planish.state.running || planish.state.program === 'program.csv'", 10)
    check("an own part becomes a program", idle(browser, "plan") in ("done", "negative") and browser.js("planish.state.program") == "program.csv", error(browser))
    check("beside a script", "planish run raster 'surface=files/part'" in (session / "session.sh").read_text())


def check_varying(browser, programs, work, session):
    """A tool that varies, as planish tool has written it."""
    subprocess.run([programs / "planish", "tool", "incidence", "--tif", session / "tool/tif", "--surface", session / "files/part", "--sphere-radius-mm", "30",
                    "--exponent=-1.7", "--out", work / "varying"], check=True, stdout=subprocess.DEVNULL)
    before = browser.js("document.getElementById('tool-source').value")
    put(browser, "tool-source", "varying")
    give(browser, "varying-file", *sorted((work / "varying").iterdir()))
    wait(browser, "planish.views.places && !document.getElementById('places-view').hidden", 20)
    least, most = browser.js("planish.views.places.map.numbers.map((n) => n[1])")
    check("a tool that varies is drawn over the part", 0 < least < 0.99 * most, (least, most))
    check("without the files of another", sorted(p.name for p in (session / "tool/varying").iterdir()) == sorted(p.name for p in (work / "varying").iterdir()))
    wait(browser, "!!planish.estimates.raster && planish.estimates.raster.key === estimateKey(planChoice(''))", 30)
    check("and estimated", browser.js("planish.estimates.raster.answer?.chosen.time_s > 0"), browser.js("planish.estimates.raster.error"))
    press(browser, "plan-form")
    wait(browser, "!!planish.state.running", 10)
    end = idle(browser, "plan")
    check("and planned", end in ("done", "negative") and "tif=tool/varying" in (session / "session.sh").read_text(), end)
    put(browser, "tool-source", before)
    press(browser, "tool-form")
    wait(browser, "document.getElementById('places-view').hidden && planish.state.session.tool.end === 'done'", 20)


def check_wrong_and_cancel(browser, work):
    (work / "notes.txt").write_text("this is no map\n")
    give(browser, "part-file", work / "notes.txt")
    wait(browser, "planish.state.session.part.end === 'refused'", 20)
    shown = browser.js("document.querySelector('#part .said .doubt').textContent")
    check("a wrong file is refused in words", "notes.txt" in shown, shown[:80])
    give(browser, "part-file", *(work / f"{n}.npy" for n in ("height_nm", "x_mm", "y_mm")))
    wait(browser, "planish.state.session.part.end === 'done'", 20)
    browser.js("document.querySelector('[data-setting=pitch_mm]').value = '0.3'")
    browser.js("document.querySelector('[data-setting=plan_joint]').value = 'yes'")
    press(browser, "plan-form")
    wait(browser, "!!planish.state.running", 10)
    check("progress is shown", not browser.js("document.getElementById('busy').hidden"))
    time.sleep(1)
    browser.js("document.getElementById('cancel').click()")
    check("a plan is cancelled", idle(browser, "plan") == "cancelled")


def check_tabs_and_restart(browser, app, programs, session):
    visit(browser, app.address)
    check("a reload keeps the session", browser.js("planish.state.session.part.end") == "done")
    other = Browser()
    visit(other, app.address)
    put(other, "part-level", "plane")
    wait(browser, "planish.state.session.part.choice.level === 'plane' && document.getElementById('part-level').value === 'plane'", 20)
    check("two tabs show the same session", True)
    other.close()
    app.kill()
    wait(browser, "!document.getElementById('error').hidden", 10)
    check("a server that is gone is named", "does not answer" in error(browser))
    again = App(programs, session)
    visit(browser, again.address)
    check("the session opens again", browser.js("planish.state.session.part.choice.level") == "plane")
    browser.js("fetch('/state').then((a) => a.status)")
    return again


def check_programs(browser, work, session):
    """Files as instruments write them, from the file to a program."""
    x, y = 0.5 * np.arange(49), 0.5 * np.arange(33)
    z = 15 * np.outer(np.cos(y / 5), np.sin(x / 6))
    write_datx(work / "mirror.datx", z[::-1] / (0.5 * WAVELENGTH * 1e9), "Fringes", 5e-4)
    write_four_sight(work / "mirror.h5", z[::-1] / 632.8, 0.5)
    mesh = np.meshgrid(x / 1e3, y / 1e3)
    write_mat(work / "mirror.mat", X=mesh[0], Y=mesh[1], Z=z / 1e9)
    for name in ("mirror.datx", "mirror.h5", "mirror.mat"):
        give(browser, "part-file", work / name)
        wait(browser, f"planish.state.session.part.choice.source.file === '{name}' && planish.state.session.part.end !== 'running'", 60)
        if name == "mirror.mat":
            wait(browser, "document.querySelectorAll('#part .asked').length > 0", 10)
            asked = browser.js("[...document.querySelectorAll('#part .asked [id]')].map((e) => e.id)")
            check("what a .mat does not state is asked for", "part-unit" in asked, asked)
            said = browser.js("document.querySelector('#part-unit').closest('label').querySelector('.refused').textContent")
            check("with the words of the reader beside the field", "is not in the file" in said, said[:80])
            browser.js("document.getElementById('part-unit').value = 'm'; document.getElementById('part-coordinate_unit').value = 'm'")
            browser.js("document.getElementById('part-unit').dispatchEvent(new Event('change'))")
            wait(browser, "planish.state.session.part.end === 'done'", 60)
        wait(browser, "planish.state.session.part.end === 'done' && planish.views.part.map.pixels[0] === 49", 20)
        rms = browser.js("planish.views.part.map.numbers[0][1]")
        # The heights of a 4Sight file are of single precision.
        check(f"{name} has its RMS", abs(rms / z.std() - 1) < 1e-6, rms)
        for setting, text in [("pitch_mm", "2"), ("plan_joint", "no"), ("refine", "no"), ("frames", "0")]:
            browser.js(f"document.querySelector('[data-setting={setting}]').value = '{text}'")
        put(browser, "controller", "csv")
        press(browser, "program-form")
        wait(browser, "!!planish.state.running", 10)
        end = idle(browser, "plan")
        size = browser.js("fetch('program').then((a) => a.text()).then((t) => t.length)")
        check(f"{name} becomes a program", end in ("done", "negative") and size > 1000, (end, size))
    browser.js("document.getElementById('part-unit').value = ''; document.getElementById('part-coordinate_unit').value = ''")


def check_files(browser, files):
    for words in files:
        file, *reading = words.split(" ")
        for name in ("unit", "coordinate_unit", "pixel_mm"):
            browser.js(f"document.getElementById('part-{name}').value = ''")
        for name, value in (word.split("=") for word in reading):
            browser.js(f"document.getElementById('part-{name}').value = {value!r}")
        begun = time.time()
        give(browser, "part-file", file)
        wait(browser, f"planish.state.session.part.choice.source.file === {pathlib.Path(file).name!r} && planish.state.session.part.end !== 'running'", 60)
        end = browser.js("planish.state.session.part.end")
        wait(browser, "Object.keys(planish.views).length > 0", 5)
        check(f"{pathlib.Path(file).name} is read", end == "done", f"{time.time() - begun:.1f} s")
    browser.js("document.getElementById('part-unit').value = ''; document.getElementById('part-coordinate_unit').value = ''")


def check_large(browser, work):
    x = 0.05 * np.arange(2000)
    np.save(work / "height_nm.npy", 30 * np.outer(np.cos(x / 9), np.sin(x / 11)))
    np.save(work / "x_mm.npy", x)
    np.save(work / "y_mm.npy", x)
    begun = time.time()
    give(browser, "part-file", *(work / f"{n}.npy" for n in ("height_nm", "x_mm", "y_mm")))
    wait(browser, "planish.views.part && planish.views.part.map.pixels[0] === 2000", 60)
    print(f"     a map of 2000 x 2000 is drawn after {browser.js('planish.views.part.seen_s'):.2f} s, {time.time() - begun:.2f} s with this program")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("programs", type=pathlib.Path)
    parser.add_argument("work", type=pathlib.Path)
    parser.add_argument("--shots", type=pathlib.Path)
    parser.add_argument("--file", action="append", default=[])
    parser.add_argument("--docs", type=pathlib.Path)
    options = parser.parse_args()
    shutil.rmtree(options.work, ignore_errors=True)
    options.work.mkdir(parents=True)
    session = options.work / "session"
    browser, app = Browser(), App(options.programs, session)
    browser.size(1280, 900)
    try:
        visit(browser, app.address)
        if options.docs:
            check_demo(browser, None)
            check_estimates(browser)
            browser.js("document.getElementById('directory').hidden = true; document.getElementById('plan').scrollIntoView()")
            browser.settle()
            return browser.shot(options.docs)
        if options.shots:
            browser.shot(options.shots / "empty.png", whole=True)
        check_demo(browser, options.shots)
        check_estimates(browser)
        check_result(browser)
        check_labels(browser)
        check_after(browser, options.programs, options.work, session)
        shots(browser, options.shots)
        complaints = [c for c in browser.complaints() if not c.startswith("request to " + app.address.rsplit("/", 2)[0])]
        check("the browser has no complaints", complaints == [], complaints[:3])
        # The browser complains of every choice that the server refuses.
        check_machine(browser)
        check_arrays(browser, options.work, session)
        check_varying(browser, options.programs, options.work, session)
        check_aperture(browser)
        check_programs(browser, options.work, session)
        check_files(browser, options.file)
        check_wrong_and_cancel(browser, options.work)
        app = check_tabs_and_restart(browser, app, options.programs, session)
        check_large(browser, options.work)
    finally:
        browser.close()
        app.kill()
    sys.exit(1 if FAILED else 0)


main()
