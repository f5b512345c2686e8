"""Plans in the page of `planish app` in headless Chromium, as a person would, from a file to a program.

    browser.py PLANISH_BIN_DIR WORK_DIR [--shots DIR] [--file MAP ...]

Every --file is a map of an instrument that is read, too, with what it does not state: --file "map.mat unit=m". Needs chromium (Debian package), numpy and websocket-client.
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

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[2] / "compare/tests"))
from chromium import FAILED, Browser, check  # noqa: E402

SHARE = pathlib.Path(__file__).resolve().parents[3]
# Widths of the pictures, px, and whether they are dark.
SCREENS = [(1280, 900, False), (1280, 900, True), (800, 900, False), (390, 844, False), (390, 844, True)]


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
    # A sixth of 7 mm is 1.167 mm; the ripple of this Gaussian of 1 mm is 0.1 % at 1.54 mm.
    check("the pitch is proposed by the tool, and not above its limit", "1.1 mm" in browser.js("document.getElementById('proposal').textContent"))
    check("its verdict is shown", "program" in browser.js("document.getElementById('program-verdict').textContent"))
    for width, height, dark in SCREENS:
        browser.size(width, height, dark)
        browser.settle()
        wide = browser.js("document.documentElement.scrollWidth")
        check(f"nothing is wider than {width} px", wide <= width, wide)
        if shots:
            browser.shot(shots / f"demo-{width}{'-dark' if dark else ''}.png", whole=True)
    browser.size(1280, 900)


def check_labels(browser):
    bare = browser.js("[...document.querySelectorAll('input, select, textarea')].filter((e) => !e.labels.length).map((e) => e.id)")
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
    check("beside a script", "planish run raster 'surface=part/surface'" in (session / "session.sh").read_text())


def check_wrong_and_cancel(browser, work):
    (work / "notes.txt").write_text("this is no map\n")
    give(browser, "part-file", work / "notes.txt")
    wait(browser, "planish.state.session.part.end === 'refused'", 20)
    shown = browser.js("document.querySelector('#part .done .doubt').textContent")
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
    print(f"     a map of 2000 x 2000 is drawn after {time.time() - begun:.2f} s")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("programs", type=pathlib.Path)
    parser.add_argument("work", type=pathlib.Path)
    parser.add_argument("--shots", type=pathlib.Path)
    parser.add_argument("--file", action="append", default=[])
    options = parser.parse_args()
    shutil.rmtree(options.work, ignore_errors=True)
    options.work.mkdir(parents=True)
    session = options.work / "session"
    browser, app = Browser(), App(options.programs, session)
    browser.size(1280, 900)
    try:
        visit(browser, app.address)
        if options.shots:
            browser.shot(options.shots / "empty.png", whole=True)
        check_demo(browser, options.shots)
        check_labels(browser)
        complaints = [c for c in browser.complaints() if not c.startswith("request to " + app.address.rsplit("/", 2)[0])]
        check("the browser has no complaints", complaints == [], complaints[:3])
        check_arrays(browser, options.work, session)
        check_files(browser, options.file)
        check_wrong_and_cancel(browser, options.work)
        app = check_tabs_and_restart(browser, app, options.programs, session)
        check_large(browser, options.work)
    finally:
        browser.close()
        app.kill()
    sys.exit(1 if FAILED else 0)


main()
